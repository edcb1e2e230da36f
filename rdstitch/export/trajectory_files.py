"""Trajectories as files: a table, a drawing, the formats of the TUM and KITTI benchmarks, which ``evo`` reads, bags.

In a ROS bag it is ``nav_msgs/Odometry`` on ``/odom``; no ROS is needed, only ``rosbags``.

Frames of reference are those of :mod:`rdstitch.geometry.path_frames`. The yaw, in all files, is the heading of the
camera, counterclockwise as seen from above (as in ROS's REP 103): φ of :class:`Trajectory`. Orientations are those of
the camera with its tilt removed, from its axes, which are those of the frame of reference when the yaw is zero, to the
frame: a turn about z by the yaw where z points up, by minus the yaw where it points down.
"""

import csv
import io
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rdstitch.arrays import FloatArray, evenly_spaced
from rdstitch.choices import TrajectoryFormat, TrajectoryFrame
from rdstitch.errors import OutputError
from rdstitch.geometry.path_frames import (
    AXES,
    NOT_MEASURED,
    covariance_in_frame,
    in_frame,
    ros_covariance,
    turn_about_z,
)
from rdstitch.system.outputs import Outputs, text_bytes
from rdstitch.trajectories.trajectory import Trajectory

_SIDE = 800.0  # pixels of the drawing's longer side
_MARGIN = 60.0  # pixels
_ARROWS = 40  # at most so many headings are drawn
_POSE = ("x", "y", "height", "yaw_deg")  # in the order of covariances
_MAX_STAMP = 2**31  # seconds of ROS have 32 bits: since 1970, until 2038
_BY_SUFFIX: dict[str, TrajectoryFormat] = {".tum": "tum", ".kitti": "kitti", ".bag": "bag"}
_PAIRS = [(i, j) for i in range(4) for j in range(i, 4)]
_COLUMNS = ("frame", "name", "source_frame", "timestamp", "x", "y", "yaw_deg", "height")


def path_as_svg(path: Trajectory, unit_name: str = "heights") -> str:
    """The path seen from above, x to the right and y downwards, with arrows where the camera heads; as SVG.

    ``unit_name`` is that of the positions, for the scale bar.
    """
    low, extent = path.position.min(axis=0), np.ptp(path.position, axis=0)
    side = float(extent.max())
    unit = _SIDE / max(side, 1e-12)
    points = (path.position - low) * unit + _MARGIN
    width, height = extent * unit + 2 * _MARGIN
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    shown = evenly_spaced(len(path), _ARROWS)
    # The camera turns by -φ when the image of the plane turns by φ; its top edge points to -y.
    heading = np.stack([-np.sin(path.yaw), -np.cos(path.yaw)], axis=1) * 0.5 * _MARGIN
    arrows = "".join(
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x + dx:.1f}" y2="{y + dy:.1f}" marker-end="url(#tip)"/>'
        for (x, y), (dx, dy) in zip(points[shown], heading[shown], strict=True)
    )
    bar, scale = "", 10.0 ** np.floor(np.log10(max(side, 1e-12)))
    if side > 0.0:  # a path that stays where it is has no scale
        bar = f"""<path d="M20,{height - 20:.1f} h{scale * unit:.1f}" stroke="black" stroke-width="2"/>
<text x="20" y="{height - 26:.1f}" font-size="14">{scale:g} {unit_name}</text>
"""
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" font-family="sans-serif">
<defs><marker id="tip" markerWidth="6" markerHeight="6" refX="3" refY="3" orient="auto">
<path d="M0,1 L5,3 L0,5 z" fill="#c33"/></marker></defs>
<rect width="100%" height="100%" fill="white"/>
<polyline points="{line}" fill="none" stroke="#236" stroke-width="2"/>
<g stroke="#c33" stroke-width="1.2">{arrows}</g>
<circle cx="{points[0, 0]:.1f}" cy="{points[0, 1]:.1f}" r="5" fill="#2a2"/>
{bar}</svg>
"""


def format_of(output: str | Path | None, file_format: TrajectoryFormat) -> TrajectoryFormat:
    """The format that is wanted, or that of the output's name."""
    suffix = Path(output or "").suffix.lower()
    if file_format == "auto" and suffix == ".svg":
        raise OutputError(f"{output}: a drawing of the path is made by --plot, beside a file of poses")
    return _BY_SUFFIX.get(suffix, "csv") if file_format == "auto" else file_format


def frame_of(file_format: str) -> TrajectoryFrame:
    """The frame of reference of a format where none is asked for: KITTI's axes are the camera's."""
    axes: dict[str, TrajectoryFrame] = {"kitti": "camera", "bag": "ros"}
    return axes.get(file_format, "enu")


def as_csv(path: Trajectory, frame: TrajectoryFrame) -> str:
    """A table with a header; what is not known of a frame is empty. Covariances, if known, are the last ten columns."""
    count = len(path)
    names = path.name or ("",) * count
    numbers = path.frame if path.source_frame is None else path.source_frame
    times = np.full(count, np.nan) if path.timestamp is None else path.timestamp
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    covariances = np.zeros((count, 0))
    if path.covariance is not None:
        units = np.array([1.0, 1.0, 1.0, np.degrees(1.0)])
        in_degrees = covariance_in_frame(path.covariance, frame) * np.outer(units, units)
        covariances = np.stack([in_degrees[:, i, j] for i, j in _PAIRS], axis=1)
    table.writerow([*_COLUMNS, *(f"cov_{_POSE[i]}_{_POSE[j]}" for i, j in _PAIRS if covariances.size)])
    poses = (path.position, np.degrees(path.yaw), path.height)
    rows = zip(path.frame, names, numbers, times, *poses, covariances + 0.0, strict=True)
    for index, name, number, time, (x, y), yaw, height, more in rows:
        seconds = f"{time:.6f}" if np.isfinite(time) else ""
        pose = (*in_frame(x, y, frame), yaw, height, *more)
        table.writerow([index, name, number, seconds, *(f"{value:.10g}" for value in pose)])
    return text.getvalue()


def as_tum(path: Trajectory, frame: TrajectoryFrame) -> str:
    """Lines ``timestamp tx ty tz qx qy qz qw``; where not every frame has a time, numbers of frames stand for them."""
    half = _heading(path, frame) / 2
    rows = zip(_times_or_numbers(path), _positions_in_frame(path, frame), np.sin(half), np.cos(half), strict=True)
    lines = [f"{time:.6f} {x:.9g} {y:.9g} {z:.9g} 0 0 {qz:.9g} {qw:.9g}" for time, (x, y, z), qz, qw in rows]
    return "\n".join(lines) + "\n"


def as_kitti(path: Trajectory, frame: TrajectoryFrame) -> str:
    """Lines of the 12 numbers of ``[R t]``, row by row; frames that were left out have no line."""
    lines = []
    for (x, y, z), turn in zip(_positions_in_frame(path, frame), _heading(path, frame), strict=True):
        c, s = np.cos(turn), np.sin(turn)
        pose = (c, -s, 0.0, x, s, c, 0.0, y, 0.0, 0.0, 1.0, z)
        lines.append(" ".join(f"{value:.9g}" for value in pose))
    return "\n".join(lines) + "\n"


def _heading(path: Trajectory, frame: TrajectoryFrame) -> FloatArray:
    """Turn of the camera about z (F,), radians."""
    return np.asarray(-turn_about_z(frame) * path.yaw)


def _positions_in_frame(path: Trajectory, frame: TrajectoryFrame) -> FloatArray:
    """x, y and z of the camera, shape (F, 3)."""
    return np.column_stack([path.position @ AXES[frame].T, -turn_about_z(frame) * path.height]) + 0.0  # no minus zero


def has_times(path: Trajectory) -> bool:
    """Check whether every frame has a time stamp."""
    return path.timestamp is not None and bool(np.isfinite(path.timestamp).all())


def _times_or_numbers(path: Trajectory) -> FloatArray:
    """Time stamps (F,), or numbers of frames where not every one has a time."""
    return np.asarray(path.timestamp if has_times(path) else path.frame)


_WRITERS: dict[str, Callable[[Trajectory, TrajectoryFrame], str]] = {"csv": as_csv, "tum": as_tum, "kitti": as_kitti}
"""By the name of the format."""


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
    if file_format == "bag" and (latest := np.abs(_times_or_numbers(path)).max()) >= _MAX_STAMP:
        raise OutputError(f"{file}: a bag has no time of {latest:.0f} s since 1970; choose another format")
    if file_format != "bag":
        outputs.write(file, text_bytes(_WRITERS[file_format](path, frame)))
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
    poses = _positions_in_frame(path, frame).tolist(), _heading(path, frame), covariances
    rows = zip(_times_or_numbers(path).tolist(), *poses, strict=True)
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
