"""A trajectory into a file, in any of the formats.

In a ROS bag it is ``nav_msgs/Odometry`` on ``/odom``; no ROS is needed, only ``rosbags``.
"""

import math
from pathlib import Path

import numpy as np

from rdstitch.choices import TrajectoryFormat, TrajectoryFrame
from rdstitch.errors import OutputError
from rdstitch.export.trajectory_files import WRITERS, frame_of, heading, positions_in_frame, times_or_numbers
from rdstitch.geometry.path_frames import NOT_MEASURED, ros_covariance
from rdstitch.system.outputs import Outputs, text_bytes
from rdstitch.trajectories.trajectory import Trajectory


def check_bag(file: Path, *, overwrite: bool) -> None:
    """Refuse a bag before long work where what writes it is missing, or a folder is there that is no bag."""
    try:
        import rosbags.rosbag1  # noqa: F401
    except ImportError:
        raise OutputError(f"{file}: writing ROS bags needs rosbags: pip install rosbags") from None
    if file.is_dir() and overwrite:
        _check_folder(file)


def _check_folder(folder: Path) -> None:
    """Refuse to replace a folder that is no bag of ROS 2."""
    others = [item.name for item in folder.iterdir() if item.suffix not in (".mcap", ".db3", ".yaml")]
    if others or not (folder / "metadata.yaml").is_file():
        raise OutputError(f"{folder}: is a folder, and not a ROS bag; choose another name")


def write_trajectory(
    path: Trajectory, file: Path, file_format: TrajectoryFormat, frame: TrajectoryFrame | None, outputs: Outputs
) -> None:
    """Stage the file, or the folder that is a bag of ROS 2, among the outputs."""
    frame = frame or frame_of(file_format)
    if file_format != "bag":
        outputs.write(file, text_bytes(WRITERS[file_format](path, frame)))
    elif file.suffix.lower() == ".bag":
        with outputs.writing(file) as staged:
            _write_bag(path, staged, frame)
    else:
        with outputs.writing_folder(file, _check_folder) as staged:
            # The files of a bag are named for their folder.
            _write_bag(path, inner := staged / file.name, frame)
            for part in inner.iterdir():
                part.rename(staged / part.name)
            inner.rmdir()


def _write_bag(path: Trajectory, file: Path, frame: TrajectoryFrame) -> None:
    """Write a bag of ROS 1 (``.bag``), or a folder, the bag of ROS 2; numbers of frames stand for times not known."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    old = file.suffix.lower() == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if old else Stores.ROS2_HUMBLE)
    # Other packages have a Time of their own.
    packages = "builtin_interfaces/", "geometry_msgs/", "nav_msgs/", "std_msgs/msg/Header"
    kinds = {name.rpartition("/")[2]: kind for name, kind in store.types.items() if name.startswith(packages)}
    writer = Writer1(file) if old else Writer2(file, version=9, storage_plugin=StoragePlugin.MCAP)
    nothing = np.diag(np.full(6, NOT_MEASURED)).ravel()
    covariances = (
        np.tile(nothing, (len(path), 1))
        if path.covariance is None
        else ros_covariance(path.covariance, frame).reshape(len(path), 36)
    )
    poses = positions_in_frame(path, frame).tolist(), heading(path, frame), covariances
    rows = zip(times_or_numbers(path).tolist(), *poses, strict=True)
    with writer as bag:
        kind = kinds["Odometry"].__msgtype__
        topic = bag.add_connection("/odom", kind, typestore=store)
        for number, (time, place, turn, covariance) in enumerate(rows):
            stamp = round(time * 1e9)
            seconds = kinds["Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
            head = kinds["Header"](stamp=seconds, frame_id="odom", **({"seq": number} if old else {}))
            quaternion = kinds["Quaternion"](x=0.0, y=0.0, z=math.sin(turn / 2), w=math.cos(turn / 2))
            pose = kinds["Pose"](position=kinds["Point"](*place), orientation=quaternion)
            still = kinds["Vector3"](x=0.0, y=0.0, z=0.0)
            twist = kinds["TwistWithCovariance"](twist=kinds["Twist"](linear=still, angular=still), covariance=nothing)
            posed = kinds["PoseWithCovariance"](pose=pose, covariance=covariance)
            message = kinds["Odometry"](header=head, child_frame_id="camera", pose=posed, twist=twist)
            data = store.serialize_ros1(message, kind) if old else store.serialize_cdr(message, kind)
            bag.write(topic, max(stamp, 0), data)
