"""All files of a run: named and checked before its work, written with its result."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np

from rdstitch.alignment.result import links_by_image
from rdstitch.choices import TrajectoryFormat
from rdstitch.compositing import Canvas
from rdstitch.export.layers import layer_files, stage_layers
from rdstitch.export.map_server import check_map_server, map_files, write_map
from rdstitch.export.poses_files import poses_file
from rdstitch.export.write_trajectory import check_bag
from rdstitch.georeferencing.georeference import world_file_paths
from rdstitch.georeferencing.place_on_map import has_place
from rdstitch.inputs.source import Source
from rdstitch.pipeline.run import Run
from rdstitch.results.messages import Message
from rdstitch.results.registration import Registration
from rdstitch.results.stitch_result import OutputImage, StitchResult
from rdstitch.system.output_checks import check_not_read, check_outputs, check_suffix
from rdstitch.system.outputs import Outputs, text_bytes
from rdstitch.viewer.page import ViewedImage, viewer_page, viewer_path


@dataclass(frozen=True)
class RunFiles:
    """Every file that a run reads, and every one that it writes."""

    read: Sequence[str | Path]
    written: Sequence[Path]
    folders: Sequence[Path] = ()  # of some of those written, made where they are missing
    layers: Mapping[str, tuple[Path, Path]] = field(default_factory=dict)  # of each image, see layer_files
    bag: Path | None = None  # folder that another bag takes the place of

    @classmethod
    def of_images(
        cls,
        run: Run,
        inputs: Iterable[str | Path],
        names: Sequence[str] = (),
        more_images: Iterable[Path] = (),
        more_files: Iterable[Path] = (),
    ) -> Self:
        """Those of a run over images of these names; ``more_images`` may follow its output."""
        options, beside = run.options, run.beside
        images = [*([] if run.output is None else [run.output]), *more_images]
        written = [*(file for image in images for file in image_files(check_suffix(image))), *more_files]
        if options.save_camera is not None:
            from rdstitch.camera_files import format_of

            format_of(options.save_camera, options.camera_format)
            written.append(options.save_camera)
        written += [file for file in (beside.report, beside.hugin_project, beside.poses) if file is not None]
        folders = []
        if beside.map_server is not None:
            check_map_server(run.output, beside.height)
            folders.append(beside.map_server)
            written += map_files(beside.map_server)
        layers: dict[str, tuple[Path, Path]] = {}
        if beside.layers is not None:
            folders.append(beside.layers)
            layers = layer_files(names, beside.layers)
            written += [file for pair in layers.values() for file in pair]
        return cls([*inputs, *run.read], written, folders, layers)

    @classmethod
    def of_path(
        cls,
        run: Run,
        inputs: Iterable[str | Path],
        output: str | Path | None,
        plot: str | Path | None,
        file_format: TrajectoryFormat,
    ) -> Self:
        """Those of a trajectory."""
        written, bag = [Path(file) for file in (output, plot) if file is not None], None
        if file_format == "bag" and output is not None:
            check_bag(written[0], overwrite=run.options.overwrite)
            if written[0].is_dir() and run.options.overwrite:  # as the bags of ROS 2 are
                bag = written.pop(0)
        return cls([*inputs, *run.read], written, bag=bag)

    def check(self, outputs: Outputs) -> None:
        """Find out before long work whether all can be written, over nothing read."""
        for folder in self.folders:
            outputs.make_folder(folder)
        check_outputs(self.written, outputs.overwrite, self.read)
        check_not_read([] if self.bag is None else [self.bag], self.read)


def image_files(output: str | Path) -> list[Path]:
    """An image and what always belongs to it: the sidecar, and the page of a Deep Zoom image."""
    page = viewer_path(output)
    return [Path(output), Path(f"{output}.json"), *([] if page is None else [page])]


def check_world_files(outputs: Iterable[str | Path], sources: Sequence[Source], overwrite: bool) -> None:
    """Find out before long work whether the files that place images on the Earth can be written, if there will be."""
    if has_place(sources):
        check_outputs([file for output in outputs for file in world_file_paths(output)], overwrite)


def stage_beside(run: Run, outputs: Outputs, result: StitchResult | Registration) -> list[Message]:
    """Stage the files beside a result; a warning for each that fails."""
    beside = run.beside
    failed: list[Message] = []

    def attempt(place: Path | None, write: Callable[[Path], object]) -> None:
        if place is not None:
            failed.extend(outputs.attempt(place, partial(write, place)))

    attempt(beside.report, lambda file: _report(run, file, outputs, result))
    if isinstance(result, StitchResult) and result.plan is None:
        attempt(beside.hugin_project, lambda file: _hugin_project(file, outputs, result))
        table = partial(poses_file, result, frame=beside.frame, height=beside.height or 1.0)
        attempt(beside.poses, lambda file: outputs.write(file, text_bytes(table(file))))
        attempt(beside.map_server, lambda folder: write_map(result, folder, beside.height or 1.0, outputs))
        attempt(beside.layers, lambda _: stage_layers(result, run.layers, outputs, whole=beside.whole_layers))
    return failed


def report_refused(run: Run, refused: Registration) -> None:
    """Write the report of a result that is refused, so that one can see why; what fails then is not the reason."""
    if run.beside.report is not None:
        with Outputs(overwrite=True) as outputs:
            outputs.attempt(run.beside.report, partial(_report, run, run.beside.report, outputs, refused))


def _report(run: Run, file: Path, outputs: Outputs, result: StitchResult | Registration) -> None:
    # Imported late: most runs have none.
    from rdstitch.report import write_report

    write_report(file, result, run.progress.stages, run.beside.command, outputs=outputs)


def _hugin_project(file: Path, outputs: Outputs, result: StitchResult) -> None:
    # Imported late: most runs have none.
    from rdstitch.export.hugin_project import project_of_hugin

    outputs.write(file, text_bytes(project_of_hugin(result.registration, result.canvas)))


def write_page(result: OutputImage, outputs: Outputs, images: Callable[[], Sequence[ViewedImage]]) -> list[Message]:
    """Write the page of a ``.dzi`` output; others have none. A warning, where it cannot be written."""
    output, written = result.output, result.written
    if output is None or written is None or (page := viewer_path(output)) is None:
        return []
    gsd = None if result.georeference is None else result.georeference.gsd

    def stage() -> None:
        text = viewer_page(output, result.canvas.size, images(), written.seams, written.origin, gsd)
        # Names of files need not be UTF-8.
        outputs.write(page, text.encode("utf-8", "backslashreplace"))

    return outputs.attempt(page, stage)


def plainly_viewed(canvas: Canvas, names: Sequence[str]) -> list[ViewedImage]:
    """The images on a canvas, of which nothing was estimated."""
    return [ViewedImage(name, outlines, ()) for name, outlines in zip(names, canvas.outlines, strict=True)]


def viewed_images(result: StitchResult) -> list[ViewedImage]:
    """The images of a result with what was found of each."""
    alignment, registration = result.registration.alignment, result.registration
    names = [source.name for source in registration.sources]
    links_of = links_by_image(alignment.holding)
    viewed = []
    for outlines, index in zip(result.canvas.outlines, np.flatnonzero(alignment.used).tolist(), strict=True):
        source = registration.sources[index]
        links = links_of.get(index, [])
        facts = [
            ("size", "{} x {} pixels".format(*source.camera.image_size)),
            ("features", str(registration.keypoints[index])),
            ("matches", str(sum(fit.inliers for fit in links))),
        ]
        partners = [f"{names[fit.image1 + fit.image2 - index]} ({fit.inliers}, {fit.rms:.2f} pixels)" for fit in links]
        facts.append(("pairs", ", ".join(partners)))
        if alignment.poses is not None:
            poses = alignment.poses
            facts += [
                ("position", "{:.3f}, {:.3f} heights".format(*poses.position[index])),
                ("height", f"{poses.height[index]:.3f}"),
                ("yaw", f"{np.degrees(poses.yaw[index]):.2f}°"),
                ("tilt", "{:.2f}°, {:.2f}°".format(*np.degrees(poses.tilt[index]))),
            ]
        if index == alignment.reference:
            facts.append(("reference", "yes"))
        viewed.append(ViewedImage(names[index], outlines, tuple(facts)))
    return viewed
