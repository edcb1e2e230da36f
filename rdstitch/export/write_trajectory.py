"""A trajectory into a file, in any of the formats."""

from pathlib import Path

from rdstitch.alignment.trajectory import Trajectory
from rdstitch.choices import TrajectoryFormat, TrajectoryFrame
from rdstitch.export.odometry_bag import write_bag, write_bag_folder
from rdstitch.export.trajectory_files import WRITERS, frame_of
from rdstitch.system.outputs import Outputs, text_bytes


def write_trajectory(
    path: Trajectory, file: Path, file_format: TrajectoryFormat, frame: TrajectoryFrame | None, outputs: Outputs
) -> None:
    """Stage the file, or the folder that is a bag of ROS 2, among the outputs."""
    frame = frame or frame_of(file_format)
    if file_format != "bag":
        outputs.write(file, text_bytes(WRITERS[file_format](path, frame)))
    elif file.suffix.lower() == ".bag":
        with outputs.writing(file) as staged:
            write_bag(path, staged, frame)
    else:
        write_bag_folder(path, file, frame, outputs)
