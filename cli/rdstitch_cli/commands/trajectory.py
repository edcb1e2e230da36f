"""``rdstitch trajectory``: the path of the camera over the plane."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from rdstitch_cli import following as live
from rdstitch_cli import options
from rdstitch_cli.help_pages import GroupedCommand
from rdstitch_cli.parameter_types import RealNumber
from rdstitch_cli.stitching import report_registration, stitch_options
from rdstitch_cli.terminal import Reporter

if TYPE_CHECKING:
    from rdstitch.inputs.frame import Named


@click.command(
    cls=GroupedCommand,
    short_help="The path of the camera over the plane, for robots.",
    epilog="""\b
Examples:
  rdstitch trajectory floor/ -o poses.csv
  rdstitch trajectory floor/ -o poses.txt --format tum --height 0.42
  rdstitch trajectory drive.bag --topic /camera/image_raw -o poses.csv
  rdstitch trajectory 0 -o poses.csv --follow | robot
""",
)
@options.inputs
@click.option("-o", "--output", type=options.IMAGE, required=True, metavar="FILE", help="File to write.")
@click.option(
    "--format",
    "layout",
    type=click.Choice(["csv", "tum", "kitti"]),
    default="csv",
    show_default=True,
    help="csv: a table with names, time stamps, x, y, yaw_deg, height and their covariances. tum: time, position and "
    "quaternion. kitti: matrices.",
)
@click.option(
    "--frame",
    type=click.Choice(["enu", "camera"]),
    help="Axes of positions. enu: x to the right and y to the top of the first image, z up; default but for kitti. "
    "camera: x to the right, y to the bottom, z down. yaw_deg is counterclockwise as seen from above in both.",
)
@click.option(
    "--height",
    type=RealNumber(),
    metavar="H",
    default=1.0,
    show_default=True,
    help="Height of the first frame above the plane, in the unit that positions shall have.",
)
@click.option(
    "--timestamps",
    type=options.IMAGE,
    metavar="FILE",
    help="Time stamps of the images: CSV name,timestamp, lines TIME NAME, or a time a line; "
    "otherwise those of the video, bag or EXIF.",
)
@click.option("--plot", type=options.IMAGE, metavar="FILE", help="Draw the path to FILE (SVG).")
@options.overwrite
@options.every_frame
@options.topic
@live.follow
@options.known
@options.estimation
@options.trust
@options.verbosity
def trajectory(
    inputs: tuple[Path, ...],
    output: Path,
    layout: Literal["csv", "tum", "kitti"],
    frame: Literal["enu", "camera"] | None,
    height: float,
    timestamps: Path | None,
    plot: Path | None,
    every: int | None,
    following: bool,
    idle: float | None,
    reporter: Reporter,
    **given: Any,
) -> None:
    """Find where the camera was for each image: x, y and yaw over the plane.

    INPUT is what 'rdstitch mosaic' takes. Positions are in units of the first image's height above the plane, or in
    metres when --height says how many those are; they are as good as the focal length (see --focal). With --follow,
    poses are printed as frames arrive.
    """
    from rdstitch.export.trajectory_files import frame_of
    from rdstitch.pipeline.follow import FollowedPoses
    from rdstitch.pipeline.recipes import trajectory as recipe

    with ExitStack() as stack:
        stitch = stitch_options(reporter, **given)
        if following:
            printed = FollowedPoses(height, timestamps, frame or frame_of(layout))
            watched: dict[str, Any] = {"output": output, "plot": plot, "every": every, "idle": idle, "poses": printed}
            arrived = live.followed(inputs, stitch, reporter, **watched)
            paths: Sequence[Named] = stack.enter_context(arrived)
        else:
            paths = options.resolve(inputs)
        how: dict[str, Any] = {
            "layout": layout,
            "timestamps": timestamps,
            "plot": plot,
            "height": height,
            "frame": frame,
        }
        _, registration = recipe(paths, output, stitch, every=every, progress=reporter, **how)
        if following:
            live.print_result(registration, reporter, output)
        else:
            report_registration(registration, reporter)
        reporter.made(f"{output}: {registration.summary}, lengths ± {registration.alignment.length_std:.2%}")
