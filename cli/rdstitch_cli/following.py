"""``--follow``: frames are registered as they arrive, one line of JSON each, and together at the end."""

import json
import sys
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from rdstitch.options.option import Option, Range
from rdstitch_cli.stitching import warn_of
from rdstitch_cli.terminal import Reporter

if TYPE_CHECKING:
    from rdstitch.pipeline.live_source import FollowedFrames, LiveSource
    from rdstitch.results.pose import Pose
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
        needs=("following",),
    ),
]


def source_to_follow(inputs: Sequence[Path], every: int | None, idle: float | None) -> "LiveSource":
    """The one input of ``--follow``."""
    from rdstitch.pipeline.live_source import LiveSource

    if len(inputs) != 1:
        raise click.UsageError("--follow takes one input: a folder, a video, the index of a camera, a stream or -")
    return LiveSource(str(inputs[0]), every, idle, sys.stdin)


def print_followed(frames: "FollowedFrames", reporter: Reporter) -> None:
    """Print a line for each frame as it arrives, until no more come, or the user interrupts."""
    for note in frames.given.notes:
        reporter.tell(note)
    try:
        with closing(frames.poses):
            _print_poses(frames.poses, reporter)
    except KeyboardInterrupt:
        reporter.note("interrupted: registering what has arrived; interrupt once more to give up")


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
