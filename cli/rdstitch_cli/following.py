"""``--follow``: frames are registered as they arrive, one line of JSON each, and together at the end."""

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from rdstitch.options.files_beside import NOTHING_BESIDE, FilesBeside
from rdstitch.options.option import Option
from rdstitch.options.stitch_options import StitchOptions
from rdstitch_cli.flags import flags
from rdstitch_cli.stitching import warn_of
from rdstitch_cli.terminal import Reporter

if TYPE_CHECKING:
    from rdstitch.inputs.arrivals import Arrivals
    from rdstitch.inputs.frame import Named
    from rdstitch.results.pose import FollowedPoses
    from rdstitch.results.registration import Registration

FOLLOWING = flags(
    following=(
        Annotated[
            bool,
            Option(
                "Register frames as they arrive, and print a line of JSON for each: INPUT is a folder that grows, - "
                "for names on standard input, a video, the index of a camera, or a stream. All are registered "
                "together at the end: of the video or the names, after --idle, or with Ctrl-C.",
                flag="--follow",
            ),
        ],
        False,
    ),
    idle=(
        Annotated[
            float | None,
            Option(
                "With --follow: end after so long without a frame; otherwise a folder is followed until Ctrl-C.",
                "SECONDS",
                above=0.0,
            ),
        ],
        None,
    ),
)


@contextmanager
def followed(
    inputs: Sequence[Path],
    stitch: StitchOptions,
    reporter: Reporter,
    *,
    output: Path,
    every: int | None,
    idle: float | None,
    refresh: float | None = None,
    plot: Path | None = None,
    poses: "FollowedPoses | None" = None,
    beside: FilesBeside = NOTHING_BESIDE,
) -> Iterator[list["Named"]]:
    """Print a line for each frame as it arrives; then, inside the block, what all of them are as inputs of a recipe.

    ``refresh`` is None where no image is made; ``plot`` will be written at the end too. ``poses`` says how poses are
    printed: as the file that is written at the end has them.
    """
    from rdstitch.inputs.arrivals import open_arrivals
    from rdstitch.system.file_access import file_state
    from rdstitch.system.temporary_folder import TemporaryFolder

    if len(inputs) != 1:
        raise click.UsageError("--follow takes one input: a folder, a video, the index of a camera, a stream or -")
    source = Path(inputs[0])
    preview = output.with_suffix(".preview.jpg") if refresh else None
    _check_files(source, stitch, output, [file for file in (preview, plot) if file is not None], beside, refresh)
    before = file_state(preview) if preview else None
    with TemporaryFolder() as folder:
        arrivals = open_arrivals(
            str(inputs[0]),
            frames_folder=lambda: folder,
            names=sys.stdin,
            every=every or 1,
            idle=idle,
            topic=stitch.topic,
        )
        try:
            _print_poses(arrivals, stitch, poses, preview, refresh or 0.0, reporter)
        except KeyboardInterrupt:
            reporter.note("interrupted: registering what has arrived; interrupt once more to give up")
        yield arrivals.inputs
    # The image that it was a preview of is there now; a file that was not replaced is the user's.
    if preview is not None and file_state(preview) != before:
        preview.unlink(missing_ok=True)


def _check_files(
    source: Path,
    stitch: StitchOptions,
    output: Path,
    others: Sequence[Path],
    beside: FilesBeside,
    refresh: float | None,
) -> None:
    """Find out before hours of frames, not after them, whether all can be written."""
    from rdstitch.camera_files import format_of
    from rdstitch.pipeline.compose import image_files
    from rdstitch.pipeline.output_plan import files_beside
    from rdstitch.system.outputs import check_outputs, check_suffix

    if source.is_dir() and output.resolve().parent == source.resolve():
        raise click.UsageError(f"{output}: lies in the folder that is followed; choose a name in another folder")
    planned = [*([output] if refresh is None else image_files(check_suffix(output)))]
    if stitch.save_camera is not None:
        format_of(stitch.save_camera, stitch.camera_format)
        planned.append(stitch.save_camera)
    check_outputs([*planned, *others, *files_beside(beside, output, [])], stitch.overwrite, [source])


def _print_poses(
    arrivals: "Arrivals",
    stitch: StitchOptions,
    poses: "FollowedPoses | None",
    preview: Path | None,
    refresh: float,
    reporter: Reporter,
) -> None:
    """One line for each frame that arrives, until no more come."""
    from rdstitch.pipeline.follow import follow

    again, read = arrivals.comes_again, True
    frames = follow(arrivals, stitch, poses, comes_again=again, preview=preview, refresh=refresh)
    with closing(frames):
        for frame in frames:
            if read:
                try:
                    print_line(frame.as_dict())
                except BrokenPipeError:
                    read = False
                    reporter.warn("nobody reads the poses any more; what arrives is registered all the same")
            for message in frame.messages:
                reporter.tell(message)


def print_line(record: dict[str, object]) -> None:
    """One line of JSON, at once."""
    click.echo(json.dumps(record, ensure_ascii=False))
    sys.stdout.flush()


def print_result(registration: "Registration", reporter: Reporter, output: Path) -> None:
    """The last line: what came of all frames together; what the user must know, to standard error."""
    reporter.finish()
    warn_of(registration, reporter)
    alignment = registration.alignment
    observable = alignment.distortion_std < float("inf")
    print_line(
        {
            "output": str(output),
            "frames": len(alignment.used),
            "used": int(alignment.used.sum()),
            "lambda": alignment.distortion if observable else None,
            "lambda_std": alignment.distortion_std if observable else None,
        }
    )
