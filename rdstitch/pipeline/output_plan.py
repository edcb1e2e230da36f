"""All files of a run: named and checked before its work, written with its result."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from rdstitch.errors import ArgumentError
from rdstitch.pipeline.compose import image_files
from rdstitch.pipeline.result_files import (
    PosesFrame,
    layer_files,
    make_folder,
    poses_file,
    project_of_hugin,
    write_layers,
)
from rdstitch.results.messages import Message
from rdstitch.results.registration import Registration
from rdstitch.results.stitch_options import StitchOptions
from rdstitch.results.stitch_result import StitchResult
from rdstitch.system.outputs import Outputs, check_outputs, check_suffix, text_bytes
from rdstitch.system.progress import StageTimer

_REPORT_SUFFIXES = (".html", ".htm")


@dataclass(frozen=True)
class FilesBeside:
    """What is written beside an image, published together with it.

    Attributes
    ----------
    report : path, optional
        HTML page; see :func:`rdstitch.write_report`. Of a result that is refused too.
    layers : path, optional
        Folder; see :func:`rdstitch.write_layers`.
    whole_layers : bool
        Layers on the whole canvas.
    hugin_project, poses : path, optional
        Project of Hugin (.pto), and table of poses as :func:`rdstitch.trajectory` writes it.
    frame : str
        Axes of the poses: "enu", "ros", "camera" or "map".
    height : float
        Of the first image above the plane, metres; positions are in metres then, and in heights with 1.
    command : str
        The command line, for the report.
    timer : StageTimer
        The ``progress`` of the recipe, whose times the report shows.
    """

    report: Path | None = None
    layers: Path | None = None
    whole_layers: bool = False
    hugin_project: Path | None = None
    poses: Path | None = None
    frame: PosesFrame = "enu"
    height: float = 1.0
    command: str = ""
    timer: StageTimer = field(default_factory=StageTimer)

    def __post_init__(self) -> None:
        for name in ("report", "layers", "hugin_project", "poses"):
            # Text is as good as a path.
            if (given := getattr(self, name)) is not None:
                object.__setattr__(self, name, Path(given))
        if self.whole_layers and self.layers is None:
            raise ArgumentError("whole layers need a folder of layers: --whole-layers goes with --layers DIR")
        if self.report is not None:
            check_suffix(self.report, _REPORT_SUFFIXES)

    def files(self, names: Iterable[str]) -> list[Path]:
        """All of them, of images of these names; makes the folder of the layers."""
        files = [file for file in (self.report, self.hugin_project, self.poses) if file is not None]
        if self.layers is not None:
            make_folder(self.layers)
            files += layer_files(list(names), self.layers)
        return files

    def stage(self, outputs: Outputs, result: StitchResult | Registration) -> list[Message]:
        """Stage them; a warning for each that fails."""
        failed: list[Message] = []

        def attempt(place: Path | None, write: Callable[[Path], object]) -> None:
            if place is not None:
                failed.extend(outputs.attempt(place, partial(write, place)))

        attempt(self.report, lambda file: self._report(file, outputs, result))
        if isinstance(result, StitchResult) and result.plan is None:
            how = {"whole": self.whole_layers, "overwrite": result.options.overwrite}
            attempt(self.hugin_project, lambda file: outputs.write(file, text_bytes(project_of_hugin(result))))
            table = partial(poses_file, result, frame=self.frame, height=self.height)
            attempt(self.poses, lambda file: outputs.write(file, text_bytes(table(file))))
            attempt(self.layers, lambda folder: write_layers(result, folder, **how, outputs=outputs))
        return failed

    def explain(self, refused: Registration) -> None:
        """Write the report of a result that is refused, so that one can see why."""
        if self.report is not None:
            with Outputs(overwrite=True) as outputs:
                self._report(self.report, outputs, refused)

    def _report(self, file: Path, outputs: Outputs, result: StitchResult | Registration) -> None:
        # Imported late: most runs have none.
        from rdstitch.report import write_report

        write_report(file, result, self.timer.stages, self.command, outputs=outputs)


NOTHING_BESIDE = FilesBeside()


def check_run(
    images: Sequence[str | Path],
    options: StitchOptions,
    beside: FilesBeside,
    inputs: Iterable[str | Path],
    names: Iterable[str],
) -> None:
    """Find out before long work whether all that images of these names become can be written, over nothing read."""
    files = [file for image in images for file in image_files(check_suffix(image))]
    if options.save_camera is not None:
        from rdstitch.camera_files import format_of

        format_of(options.save_camera, options.camera_format)
        files.append(options.save_camera)
    files += beside.files(names)
    check_outputs(files, options.overwrite, [*inputs, *options.files])
