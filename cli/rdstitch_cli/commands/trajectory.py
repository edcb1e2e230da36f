"""``rdstitch trajectory``: the path of the camera over the plane."""

from pathlib import Path
from typing import Annotated, Any

from rdstitch.choices import TrajectoryFormat, TrajectoryFrame
from rdstitch.options.feature_options import FeatureOptions
from rdstitch.options.option import FileUse, Option
from rdstitch.options.shared_options import Every, Height
from rdstitch.options.stitch_options import StitchOptions
from rdstitch_cli.flags import Inputs, command, flags_of
from rdstitch_cli.following import Following, Idle, print_followed, print_result, source_to_follow
from rdstitch_cli.stitching import report_registration, resolve, stitch_options
from rdstitch_cli.terminal import Reporter


@command(
    """
  rdstitch trajectory floor/ -o poses.csv
  rdstitch trajectory floor/ -o poses.txt --format tum --height 0.42
  rdstitch trajectory drive.bag --topic /camera/image_raw -o poses.csv
  rdstitch trajectory 0 -o poses.csv --follow | robot
""",
    flags_of(StitchOptions, without="reference gcp check_points local_alignment dry_run save_camera camera_format"),
    flags_of(FeatureOptions),
)
def trajectory(
    inputs: Inputs,
    output: Annotated[Path, Option("File to write.", "FILE", "-o --output", file=FileUse.WRITTEN)],
    *,
    file_format: Annotated[
        TrajectoryFormat,
        Option(
            "auto: by the name, .tum, .kitti or .bag, otherwise csv. csv: a table with names, time stamps, x, y, "
            "yaw_deg, height and their covariances. tum: time, position and quaternion. kitti: matrices. bag: "
            "nav_msgs/Odometry on /odom, ROS 1 (.bag) or ROS 2 (a folder).",
            flag="--format",
        ),
    ] = "auto",
    frame: Annotated[
        TrajectoryFrame | None,
        Option(
            "Axes of positions. enu: x to the right and y to the top of the first image, z up; default of csv and tum. "
            "ros: x to the top, y to the left, z up; default of bag. camera, or first: x to the right, y to the "
            "bottom, z down; default of kitti. yaw_deg is counterclockwise as seen from above in all."
        ),
    ] = None,
    height: Height = None,
    plot: Annotated[Path | None, Option("Draw the path to FILE (SVG).", "FILE", file=FileUse.WRITTEN)] = None,
    every: Every = 1,
    following: Following = False,
    idle: Idle = None,
    reporter: Reporter,
    **given: Any,
) -> None:
    """Find where the camera was for each image: x, y and yaw over the plane.

    INPUT is what 'rdstitch mosaic' takes. Positions are in units of the first image's height above the plane, or in
    metres when --height says how many those are; they are as good as the focal length (see --focal). With --follow,
    poses are printed as frames arrive.
    """
    from rdstitch.export.trajectory_files import format_of, frame_of
    from rdstitch.pipeline.recipes import trajectory as recipe

    options, file_format = stitch_options(given), format_of(output, file_format)
    how: dict[str, Any] = {"file_format": file_format, "plot": plot, "height": height, "frame": frame, "every": every}
    if following:
        from rdstitch.pipeline.live_source import follow_for_trajectory
        from rdstitch.results.pose import FollowedPoses

        source, poses = source_to_follow(inputs, every, idle), FollowedPoses(height, frame or frame_of(file_format))
        with follow_for_trajectory(source, output, options, poses, plot=plot, file_format=file_format) as frames:
            print_followed(frames, reporter)
            path, registration = recipe(frames.images, output, frames.given.options, progress=reporter, **how)
            print_result(registration, reporter, output)
    else:
        path, registration = recipe(resolve(inputs), output, options, progress=reporter, **how)
        report_registration(registration, reporter)
    reporter.made(f"{output}: {registration.summary}, lengths ± {path.length_std:.2%}")
