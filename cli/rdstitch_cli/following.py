"""``--follow``: frames are registered as they arrive, one line of JSON each, and together at the end."""

import json
import sys
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from rdstitch.options.option import Option, Range
from rdstitch_cli.stitching import warn_of
from rdstitch_cli.terminal import Reporter

if TYPE_CHECKING:
    from rdstitch.inputs.frame import Named
    from rdstitch.pipeline.output_plan import OutputPlan
    from rdstitch.results.pose import FollowedPoses, Pose
    from rdstitch.results.registration import Registration

Following = Annotated[
    bool,
    Option(
        "Register frames as they arrive, and print a line of JSON for each: INPUT is a folder that grows, - "
        "for names on standard input, a video, the index of a camera, or a stream. All are registered "
        "together at the end: of the video or the names, after --idle, or with Ctrl-C.",
        flag="--follow",
    ),
]
Idle = Annotated[
    float | None,
    Option(
        "With --follow: end after so long without a frame; otherwise a folder is followed until Ctrl-C.",
        "SECONDS",
        within=Range(above=0.0),
    ),
]


@contextmanager
def followed(
    plan: "OutputPlan",
    reporter: Reporter,
    *,
    idle: float | None,
    preview: Path | None = None,
    refresh: float = 0.0,
    poses: "FollowedPoses | None" = None,
) -> Iterator[list["Named"]]:
    """Print a line for each frame as it arrives; then, inside the block, what all of them are as inputs of a recipe."""
    from rdstitch.inputs.frame_stream import open_frame_stream
    from rdstitch.pipeline.follow import follow
    from rdstitch.system.file_access import file_state
    from rdstitch.system.temporary_folder import TemporaryFolder

    run = plan.run
    if len(run.inputs) != 1:
        raise click.UsageError("--follow takes one input: a folder, a video, the index of a camera, a stream or -")
    (given,) = map(str, run.inputs)  # as a path an address would lose one of its slashes
    source, output = Path(given), plan.replaced_bag or next(iter((*plan.images, *plan.files)))
    if source.is_dir() and output.resolve().parent == source.resolve():
        raise click.UsageError(f"{output}: lies in the folder that is followed; choose a name in another folder")
    with run.outputs:
        plan.check()
    for note in run.notes:
        reporter.tell(note)
    before = None if preview is None else file_state(preview)
    with TemporaryFolder() as folder:
        arrivals = open_frame_stream(
            given,
            frames_folder=lambda: folder,
            names=sys.stdin,
            every=run.every or 1,
            idle=idle,
            topic=run.options.topic,
        )
        again = arrivals.comes_again
        frames = follow(arrivals, run.options, poses, comes_again=again, preview=preview, refresh=refresh)
        try:
            with closing(frames):
                _print_poses(frames, reporter)
        except KeyboardInterrupt:
            reporter.note("interrupted: registering what has arrived; interrupt once more to give up")
        yield arrivals.inputs
    # The image that it was a preview of is there now; a file that was not replaced is the user's.
    if preview is not None and file_state(preview) != before:
        preview.unlink(missing_ok=True)


def _print_poses(frames: Iterable["Pose"], reporter: Reporter) -> None:
    read = True
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
    observable = alignment.lens_observable
    print_line(
        {
            "output": str(output),
            "frames": len(alignment.used),
            "used": int(alignment.used.sum()),
            "lambda": alignment.distortion if observable else None,
            "lambda_std": alignment.distortion_std if observable else None,
        }
    )
