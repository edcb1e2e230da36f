"""Frames followed as they arrive, before a recipe registers all of them together."""

from collections.abc import Generator, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from rdstitch.choices import Purpose, TrajectoryFormat
from rdstitch.errors import ArgumentError
from rdstitch.inputs.frame import Named
from rdstitch.inputs.frame_stream import open_frame_stream
from rdstitch.options.files_beside import FilesBeside
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.follow import follow
from rdstitch.pipeline.outputs.output_files import OutputFiles
from rdstitch.pipeline.run import RecipeInput, Run
from rdstitch.results.pose import FollowedPoses, Pose
from rdstitch.system.file_access import file_state
from rdstitch.system.temporary_folder import TemporaryFolder
from rdstitch.tracking.preview import LivePreview


@dataclass(frozen=True)
class LiveSource:
    """A folder that grows, a video, the index of a camera, a stream, or "-" for a list of names."""

    name: str
    every: int | None = None  # every n-th frame of a video, camera or stream
    idle: float | None = None  # seconds without a frame after which it ends
    names: IO[str] | None = None  # the list of names, one a line

    def refuse_in_folder(self, output: Path) -> None:
        """Refuse an output that would arrive as a frame."""
        folder = Path(self.name)
        if folder.is_dir() and output.resolve().parent == folder.resolve():
            raise ArgumentError(f"{output}: lies in the folder that is followed; choose a name in another folder")


@dataclass(frozen=True)
class FollowedFrames:
    """The frames of a source that is followed."""

    poses: Generator[Pose]  # of each as it arrives
    images: Sequence[Named]  # all that have arrived, for a recipe
    given: RecipeInput  # what was read of camera and odometry


@contextmanager
def follow_for_mosaic(
    source: LiveSource, output: Path, options: StitchOptions, beside: FilesBeside, *, refresh: float
) -> Iterator[FollowedFrames]:
    """Follow a source before :func:`rdstitch.mosaic`, whose output replaces a preview.

    The preview is written every ``refresh`` seconds at most, not at all for 0.
    """
    source.refuse_in_folder(output)
    given = RecipeInput.of([source.name], options, Purpose.MOSAIC, source.every)
    run, preview = Run.of(given, output, beside), output.with_suffix(".preview.jpg")
    files = OutputFiles.of_images(run, [source.name, *given.files], more_files=[preview] if refresh else [])
    before = file_state(preview)
    with _followed(source, given, files, preview=LivePreview(preview, refresh) if refresh else None) as frames:
        yield frames
    # The image that it was a preview of is there now; a file that was not replaced is the user's.
    if refresh and file_state(preview) != before:
        preview.unlink(missing_ok=True)


def follow_for_trajectory(
    source: LiveSource,
    output: Path,
    options: StitchOptions,
    poses: FollowedPoses,
    *,
    plot: Path | None,
    file_format: TrajectoryFormat,
) -> AbstractContextManager[FollowedFrames]:
    """Follow a source before :func:`rdstitch.trajectory`."""
    source.refuse_in_folder(output)
    given = RecipeInput.of([source.name], options, Purpose.TRAJECTORY, source.every)
    files = OutputFiles.of_path(Run.of(given), [source.name, *given.files], output, plot, file_format)
    return _followed(source, given, files, poses)


@contextmanager
def _followed(
    source: LiveSource,
    given: RecipeInput,
    files: OutputFiles,
    poses: FollowedPoses | None = None,
    preview: LivePreview | None = None,
) -> Iterator[FollowedFrames]:
    with files.run.outputs:
        files.check()
    with TemporaryFolder() as folder:
        arrivals = open_frame_stream(
            source.name,
            frames_folder=lambda: folder,
            names=source.names,
            every=source.every or 1,
            idle=source.idle,
            topic=given.options.topic,
        )
        followed = follow(arrivals, given.options, poses, comes_again=arrivals.comes_again, preview=preview)
        yield FollowedFrames(followed, arrivals.inputs, given)
