"""``rdstitch trajectory``: the path of the camera over the plane."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rdstitch_cli import following as live
from rdstitch_cli import options
from rdstitch_cli.help_pages import command
from rdstitch_cli.option_texts import option
from rdstitch_cli.parameter_types import RealNumber
from rdstitch_cli.stitching import report_registration, stitch_options
from rdstitch_cli.terminal import Reporter

if TYPE_CHECKING:
    from rdstitch.inputs.frame import Named


@command(
    "The path of the camera over the plane, for robots.",
    """
  rdstitch trajectory floor/ -o poses.csv
  rdstitch trajectory floor/ -o poses.txt --format tum --height 0.42
  rdstitch trajectory drive.bag --topic /camera/image_raw -o poses.csv
  rdstitch trajectory 0 -o poses.csv --follow | robot
""",
)
@options.inputs
@option("-o --output", options.IMAGE, of="trajectory", required=True)
@option("--format", ("csv", "tum", "kitti", "bag"), "csv", of="trajectory", dest="layout")
@option("--frame", ("enu", "ros", "camera"), of="trajectory")
@option("--height", RealNumber(), 1.0)
@option("--plot", options.IMAGE)
@options.overwrite
@options.every_frame
@options.topic
@options.follow
@options.known
@options.estimation
@options.trust
@options.verbosity
def trajectory(
    inputs: tuple[Path, ...],
    output: Path,
    layout: Literal["csv", "tum", "kitti", "bag"],
    frame: Literal["enu", "ros", "camera"] | None,
    height: float,
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
            printed = FollowedPoses(height, frame or frame_of(layout))
            watched: dict[str, Any] = {"output": output, "plot": plot, "every": every, "idle": idle, "poses": printed}
            arrived = live.followed(inputs, stitch, reporter, **watched)
            paths: Sequence[Named] = stack.enter_context(arrived)
        else:
            paths = options.resolve(inputs)
        how: dict[str, Any] = {
            "layout": layout,
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
