"""The files that a run writes: checked before its work, staged with its result."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Self

from rdstitch.choices import TrajectoryFormat
from rdstitch.errors import ArgumentError
from rdstitch.export.layers import layer_files, stage_layers
from rdstitch.export.map_server import check_map_server, map_files, write_map
from rdstitch.export.poses_files import poses_file
from rdstitch.export.trajectory_files import check_bag
from rdstitch.georeferencing.georeference import world_file_paths
from rdstitch.georeferencing.place_on_map import MIN_POSITIONS, has_place
from rdstitch.inputs.source import Source
from rdstitch.pipeline.camera_path import focal_unknown
from rdstitch.pipeline.run import Run
from rdstitch.results.messages import Message
from rdstitch.results.registration import Registration
from rdstitch.results.stitch_result import StitchResult
from rdstitch.system.output_checks import check_not_read, check_outputs, check_suffix
from rdstitch.system.outputs import Outputs, text_bytes
from rdstitch.viewer.page import viewer_path

_REPORT_SUFFIXES = (".html", ".htm")


def file_of_part(file: Path, part: str | int) -> Path:
    """The file of a block or of a band, of the same format: ``field-2.tif``, ``field-NIR.ome.tif``."""
    stem = file.stem[:-4] if file.stem.lower().endswith(".ome") else file.stem
    return file.with_name(f"{stem}-{part}{file.name.removeprefix(stem)}")


@dataclass(frozen=True)
class FileBeside:
    """A file or folder written beside an image, which is published even if this one fails."""

    place: Path  # the file, or folder, that the user named
    stage: Callable[[StitchResult], object]
    in_folder: Sequence[Path] | None = None  # files in a folder, which is made where it is missing

    @property
    def files(self) -> Sequence[Path]:
        """All that is written."""
        return [self.place] if self.in_folder is None else self.in_folder


@dataclass(frozen=True)
class OutputFiles:
    """Every file that a run writes, and those that it reads."""

    run: Run
    read: Sequence[str | Path]
    images: Sequence[Path] = ()
    files: Sequence[Path] = ()  # besides the images and what belongs to these
    beside: Sequence[FileBeside] = ()
    replaced_bag: Path | None = None  # folder that another bag takes the place of

    @classmethod
    def of_images(
        cls,
        run: Run,
        inputs: Sequence[str | Path],
        names: Sequence[str] = (),
        more_images: Sequence[Path] = (),
        more_files: Sequence[Path] = (),
    ) -> Self:
        """The files of a run over images of these names; ``more_images`` may be written after its output."""
        images = [*([] if run.output is None else [run.output]), *more_images]
        return cls(run, inputs, images, more_files, list(_files_beside(run, names)))

    @classmethod
    def of_path(
        cls,
        run: Run,
        inputs: Sequence[str | Path],
        output: str | Path | None,
        plot: str | Path | None,
        file_format: TrajectoryFormat,
    ) -> Self:
        """The files of a trajectory."""
        files, replaced = [Path(file) for file in (output, plot) if file is not None], None
        files += _camera_file(run)
        if file_format == "bag" and output is not None:
            check_bag(files[0], overwrite=run.options.overwrite)
            if files[0].is_dir() and run.options.overwrite:  # as the bags of ROS 2 are
                replaced = files.pop(0)
        return cls(run, inputs, files=files, replaced_bag=replaced)

    def check(self) -> None:
        """Refuse early what cannot be written, or would overwrite an input."""
        outputs = self.run.outputs
        for extra in self.beside:
            if extra.in_folder is not None:
                outputs.make_folder(extra.place)
        of_images = [file for image in self.images for file in _image_files(check_suffix(image))]
        beside = [file for extra in self.beside for file in extra.files]
        check_outputs([*of_images, *self.files, *beside], self._may_exist, self.read)
        check_not_read([] if self.replaced_bag is None else [self.replaced_bag], self.read)

    @property
    def _may_exist(self) -> bool:
        return self.run.outputs.overwrite or self.run.options.dry_run  # which writes nothing

    def check_places(self, sources: Sequence[Source], *, placed: bool = False) -> None:
        """Check world files too, once it is known whether the output will be georeferenced.

        It is by the positions of the images, or if they are ``placed`` by an earlier output.
        """
        run = self.run
        if run.options.composite.georeference != "off" and (placed or has_place(sources)):
            files = [file for image in self.images for file in world_file_paths(image)]
            check_outputs(files, self._may_exist)
        elif run.beside.has_poses_on_map:
            raise ArgumentError(
                f"{run.beside.poses}: poses on the map need a georeferenced output, and GPS positions of "
                f"{MIN_POSITIONS} images or ground control points; choose another --frame, or another name"
            )

    def stage(self, result: StitchResult) -> StitchResult:
        """Stage the files beside an image; the result gets a warning for each that fails."""
        for each in self.beside:
            result = result.with_messages(self.run.outputs.attempt(each.place, partial(each.stage, result)))
        if self.run.beside.poses is None or result.registration.alignment.poses is None:
            return result
        lengths = "heights above the ground, or places in units of them,"
        return result.with_messages(focal_unknown(lengths, result.registration.alignment.length_std))


def save_camera(registration: Registration, run: Run) -> None:
    """Stage the camera file, if one is wanted."""
    options = run.options
    if options.save_camera is not None:
        from rdstitch.camera_files import camera_file_text

        text = camera_file_text(registration.camera, options.save_camera, options.camera_format)
        run.outputs.write(options.save_camera, text_bytes(text))


def stage_report(run: Run, result: Registration) -> list[Message]:
    """Stage the report of a registration, if one is wanted; with a warning if that fails."""
    file = run.beside.report
    return [] if file is None else run.outputs.attempt(file, partial(_write_report, run, file, run.outputs, result))


def report_refused(run: Run, refused: Registration) -> None:
    """Write the report of a refused result, which shows why; errors of the report itself are ignored."""
    if (file := run.beside.report) is not None:
        with Outputs(overwrite=True) as outputs:
            outputs.attempt(file, partial(_write_report, run, file, outputs, refused))


def _camera_file(run: Run) -> list[Path]:
    """The camera file, if one is wanted; its format is checked."""
    file = run.options.save_camera
    if file is None:
        return []
    from rdstitch.camera_files import format_of  # with all formats, which most runs have no use for

    format_of(file, run.options.camera_format)
    return [file]


def _image_files(output: Path) -> list[Path]:
    """An image with its sidecar, and with its page if it is a Deep Zoom image."""
    page = viewer_path(output)
    return [output, Path(f"{output}.json"), *([] if page is None else [page])]


def _files_beside(run: Run, names: Sequence[str]) -> Iterator[FileBeside]:
    """The files beside an image that is composed of images with these names."""
    beside, outputs = run.beside, run.outputs
    for camera in _camera_file(run):
        yield FileBeside(camera, lambda result: save_camera(result.registration, run))
    if (report := beside.report) is not None:
        yield FileBeside(check_suffix(report, _REPORT_SUFFIXES), partial(_write_report, run, report, outputs))
    if (project := beside.hugin_project) is not None:
        yield FileBeside(project, partial(_write_hugin_project, project, outputs))
    if (table := beside.poses) is not None:
        height = beside.height or 1.0

        def write_poses(result: StitchResult) -> None:
            outputs.write(table, text_bytes(poses_file(result, table, beside.frame, height)))

        yield FileBeside(table, write_poses)
    if (map_folder := beside.map_server) is not None:
        check_map_server(run.output, beside.height)
        write = partial(write_map, folder=map_folder, height=beside.height or 1.0, outputs=outputs)
        yield FileBeside(map_folder, write, map_files(map_folder))
    if beside.layers is not None:
        layers = layer_files(names, beside.layers)
        stage = partial(stage_layers, files=layers, outputs=outputs, whole=beside.whole_layers)
        yield FileBeside(beside.layers, stage, [file for pair in layers.values() for file in pair])


def _write_report(run: Run, file: Path, outputs: Outputs, result: StitchResult | Registration) -> None:
    from rdstitch.report import write_report  # most runs have none

    write_report(file, result, run.progress.stages, run.beside.command, outputs=outputs)


def _write_hugin_project(file: Path, outputs: Outputs, result: StitchResult) -> None:
    from rdstitch.export.hugin_project import project_of_hugin  # most runs have none

    outputs.write(file, text_bytes(project_of_hugin(result.registration, result.canvas)))
