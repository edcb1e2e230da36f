"""What all stages of one run have in common."""

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Self

from rdstitch.alignment.motion_models import MODELS
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
    """What the user decided, what is read, where results and progress go, and what is noticed meanwhile."""

    options: StitchOptions
    output: Path | None = None  # image to write; None for one in memory
    beside: FilesBeside = NOTHING_BESIDE
    purpose: Purpose = Purpose.MOSAIC
    inputs: Sequence[Named] = ()
    every: int | None = None
    read: Sequence[Path] = ()  # files that are read besides the images
    notes: Sequence[Message] = ()  # on what is given besides the images
    progress: StageTimer = field(default_factory=StageTimer)  # it knows how long each stage took, for the report
    guard: InputGuard = field(default_factory=InputGuard)  # what all who read the input files notice of them
    keeps_cache: bool = True  # whether the folder of the cache outlasts the run
    outputs: Outputs = field(default_factory=partial(Outputs, overwrite=False))  # what is staged

    @classmethod
    def of(
        cls,
        inputs: Images,
        options: StitchOptions | None,
        purpose: Purpose = Purpose.MOSAIC,
        output: str | Path | None = None,
        *,
        beside: FilesBeside = NOTHING_BESIDE,
        every: int | None = None,
        progress: Progress = silent,
    ) -> Self:
        """Begin a run over inputs; the camera, and the odometry of a path, are read that options name, or a bag has."""
        options, beside = options_of(StitchOptions, options), options_of(FilesBeside, beside, "beside")
        check_parameter("every", Every, every)
        given, file = as_inputs(inputs, options.channel_order), None if output is None else Path(output)
        if options.dry_run and not purpose.picture:
            raise ArgumentError(f"{purpose} composites nothing: leave out dry_run")
        if beside.frame == "first" and options.reference is not None:
            raise ArgumentError("reference and frame first both name the reference; leave one of them out")
        if beside.poses is not None:
            options = replace(options, pose_covariance=True)
        has_poses = options.model == "auto" or MODELS[options.model].has_metric_poses
        if not has_poses and (purpose.poses or beside.poses is not None or beside.map_server is not None):
            raise ArgumentError(f"a {options.model} model has no poses; choose another one, such as tilting")
        if purpose.poses:
            options = with_odometry_of_bag(given, options)
        known, notes = with_camera(options, given, of_bag=purpose is not Purpose.CALIBRATE)
        return cls(
            options=known,
            output=file,
            beside=beside,
            purpose=purpose,
            inputs=given,
            every=every,
            read=options.files,
            notes=notes,
            progress=StageTimer(progress),
            guard=InputGuard(options.strict),
            outputs=Outputs(options.overwrite),
        )

    @contextmanager
    def open_images(self, *also_written: Path) -> Iterator[FoundImages]:
        """The images, none of which is among the outputs; in the end all that was staged is published."""
        written = [self.output, *also_written]
        with (
            found_images(self.inputs, outputs=written, every=self.every, topic=self.options.topic) as images,
            self.outputs,
        ):
            yield images

    def executor(self, images: int) -> Executor:
        """Where the tasks of so many images are computed; to be used in a ``with`` block."""
        options = self.options
        return open_executor(options.threads, images, scheduler=options.scheduler, store=options.cache)
