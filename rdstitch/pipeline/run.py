"""What a recipe is given, and what all its stages have in common."""

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
from rdstitch.inputs.source import Source
from rdstitch.options.files_beside import NOTHING_BESIDE, FilesBeside
from rdstitch.options.option import check_parameter, options_of
from rdstitch.options.shared_options import Every
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.inputs.camera_and_odometry import with_camera, with_odometry_of_bag
from rdstitch.results.messages import Message
from rdstitch.system.outputs import Outputs
from rdstitch.system.progress import Progress, StageTimer, silent


@dataclass(frozen=True)
class RecipeInput:
    """The images and options that a recipe is given; camera and odometry are read from their files."""

    images: Sequence[Named]
    options: StitchOptions
    purpose: Purpose = Purpose.MOSAIC
    every: int | None = None  # every n-th frame of videos and bags; None: those that show new ground
    files: Sequence[Path] = ()  # that are read besides the images
    notes: Sequence[Message] = ()  # on the camera

    @classmethod
    def of(cls, images: Images, options: StitchOptions | None, purpose: Purpose, every: int | None) -> Self:
        """Read the camera that the options name, or a bag has, and the odometry of a trajectory."""
        options = options_of(StitchOptions, options)
        check_parameter("every", Every, every)
        named, files = as_inputs(images, options.channel_order), options.files
        if purpose.poses:
            options = with_odometry_of_bag(named, options)
        options, notes = with_camera(options, named, of_bag=purpose is not Purpose.CALIBRATE)
        return cls(named, options, purpose, every, files, notes)

    @contextmanager
    def find_images(self, *outputs: Path | None) -> Iterator[FoundImages]:
        """The images, none of which is among the outputs, with all files that are read; for the length of the block."""
        with found_images(self.images, outputs=outputs, every=self.every, topic=self.options.topic) as found:
            containers, notes = (*found.containers, *self.files), (*found.notes, *self.notes)
            yield replace(found, containers=containers, notes=notes)


@dataclass(frozen=True)
class Run:
    """What the stages of a recipe share: what the user decided, where results and progress go, and notes on files."""

    options: StitchOptions
    purpose: Purpose = Purpose.MOSAIC
    output: Path | None = None  # image to write; None for one in memory
    beside: FilesBeside = NOTHING_BESIDE
    temporary_cache: Path | None = None  # folder that serves as the cache where the options name none
    progress: StageTimer = field(default_factory=StageTimer)  # it knows how long each stage took, for the report
    guard: InputGuard = field(default_factory=InputGuard)  # notes of all who read the input files
    outputs: Outputs = field(default_factory=partial(Outputs, overwrite=False))  # what is staged

    @classmethod
    def of(
        cls,
        given: RecipeInput,
        output: str | Path | None = None,
        beside: FilesBeside = NOTHING_BESIDE,
        progress: Progress = silent,
    ) -> Self:
        """Check that what is wanted can be had of what is given."""
        options, purpose, beside = given.options, given.purpose, options_of(FilesBeside, beside, "beside")
        if options.dry_run and not purpose.picture:
            raise ArgumentError(f"{purpose} composites nothing: leave out dry_run")
        if beside.frame == "first" and options.reference is not None:
            raise ArgumentError("reference and frame first both name the reference; leave one of them out")
        has_poses = options.model == "auto" or MODELS[options.model].has_metric_poses
        if not has_poses and (purpose.poses or beside.poses is not None or beside.map_server is not None):
            raise ArgumentError(f"a {options.model} model has no poses; choose another one, such as tilting")
        return cls(
            options=replace(options, pose_covariance=True) if purpose.poses or beside.poses is not None else options,
            purpose=purpose,
            output=None if output is None else Path(output),
            beside=beside,
            progress=StageTimer(progress),
            guard=InputGuard(options.strict),
            outputs=Outputs(options.overwrite),
        )

    def of_part(
        self,
        output: Path,
        options: StitchOptions,
        beside: FilesBeside = NOTHING_BESIDE,
        temporary_cache: Path | None = None,
    ) -> Self:
        """The run over a part of the images, whose output is published with all others, with notes of its own."""
        guard = InputGuard(options.strict)
        return replace(
            self, options=options, output=output, beside=beside, temporary_cache=temporary_cache, guard=guard
        )

    def with_reference(self, image: Source) -> Self:
        """The same run with another reference image."""
        return replace(self, options=replace(self.options, reference=image.name))

    @property
    def cache(self) -> Path | None:
        """Folder of what was computed earlier."""
        return self.options.cache or self.temporary_cache

    def executor(self, images: int) -> Executor:
        """Where the tasks of so many images are computed; to be used in a ``with`` block."""
        options = self.options
        return open_executor(options.threads, images, scheduler=options.scheduler, store=self.cache)
