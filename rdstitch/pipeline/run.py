"""What all stages of one run have in common."""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

from rdstitch.choices import Purpose
from rdstitch.errors import ArgumentError
from rdstitch.executors import open_executor
from rdstitch.inputs.find import FoundImages, found_images
from rdstitch.inputs.frame import Images, Named, as_inputs
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.options.files_beside import NOTHING_BESIDE, FilesBeside
from rdstitch.options.option import check_parameter, options_of
from rdstitch.options.shared_options import Every
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.camera_path import with_odometry_of_bag
from rdstitch.pipeline.given_camera import with_camera
from rdstitch.results.messages import Message
from rdstitch.system.outputs import Outputs
from rdstitch.system.progress import Progress, StageTimer, silent


@dataclass(frozen=True)
class Run:
    """What the user decided, what is read and written, and what is noticed meanwhile."""

    options: StitchOptions
    output: Path | None = None  # image to write; None for one in memory
    beside: FilesBeside = NOTHING_BESIDE
    progress: StageTimer = field(default_factory=StageTimer)  # it knows how long each stage took, for the report
    purpose: Purpose = Purpose.MOSAIC
    guard: InputGuard = field(default_factory=InputGuard)  # what all who read the input files notice of them
    read: Sequence[Path] = ()  # files that are read besides the images
    notes: Sequence[Message] = ()  # on what is given besides the images
    layers: Mapping[str, tuple[Path, Path]] = field(default_factory=dict)  # files of each image's layer and mask

    @classmethod
    def of(
        cls,
        inputs: Sequence[Named],
        options: StitchOptions | None,
        output: str | Path | None = None,
        beside: FilesBeside = NOTHING_BESIDE,
        progress: Progress = silent,
        purpose: Purpose = Purpose.MOSAIC,
    ) -> Self:
        """Begin a run over inputs; the camera, and the odometry of a path, are read that options name, or a bag has."""
        options = options or StitchOptions()
        if beside.frame == "first" and options.reference is not None:
            raise ArgumentError("reference and frame first both name the reference; leave one of them out")
        if beside.poses is not None:
            options = replace(options, pose_covariance=True)
        if purpose is Purpose.TRAJECTORY:
            options = with_odometry_of_bag(inputs, options)
        known, notes = with_camera(options, inputs, of_bag=purpose is not Purpose.CALIBRATE)
        file, timer, guard = None if output is None else Path(output), StageTimer(progress), InputGuard(options.strict)
        return cls(known, file, beside, timer, purpose, guard, options.files, notes)

    def executor(self, images: int) -> Executor:
        """Where the tasks of so many images are computed; to be used in a ``with`` block."""
        options = self.options
        return open_executor(options.threads, images, scheduler=options.scheduler, store=options.cache)


@contextmanager
def started(
    inputs: Images,
    options: StitchOptions | None,
    purpose: Purpose,
    output: str | Path | None = None,
    *,
    every: int | None,
    progress: Progress,
    beside: FilesBeside = NOTHING_BESIDE,
    also_written: Sequence[Path] = (),
) -> Iterator[tuple[FoundImages, Run, Outputs]]:
    """Find images, none of which is among the outputs, and begin a run over them; files are published in the end."""
    options, beside = options_of(StitchOptions, options), options_of(FilesBeside, beside, "beside")
    check_parameter("every", Every, every)
    given = as_inputs(inputs, options.channel_order)
    run = Run.of(given, options, output, beside, progress, purpose)
    with (
        found_images(given, outputs=[run.output, *also_written], every=every, topic=options.topic) as listed,
        Outputs(options.overwrite) as outputs,
    ):
        yield listed, run, outputs
