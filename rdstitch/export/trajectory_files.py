"""Trajectories as files: a table, a drawing, and the formats of the TUM and KITTI benchmarks, which ``evo`` reads.

Frames of reference are those of :mod:`rdstitch.geometry.path_frames`. The yaw, in all files, is the heading of the
camera, counterclockwise as seen from above (as in ROS's REP 103): φ of :class:`Trajectory`. Orientations are those of
the camera with its tilt removed, from its axes, which are those of the frame of reference when the yaw is zero, to the
frame: a turn about z by the yaw where z points up, by minus the yaw where it points down.
"""

import csv
import io
from collections.abc import Callable

import numpy as np

from rdstitch.arrays import FloatArray, evenly_spaced
from rdstitch.choices import TrajectoryFrame
from rdstitch.geometry.path_frames import AXES, covariance_in_frame, in_frame, turn_about_z
from rdstitch.trajectories.trajectory import Trajectory

_SIDE = 800.0  # pixels of the drawing's longer side
_MARGIN = 60.0  # pixels
_ARROWS = 40  # at most so many headings are drawn
_POSE = ("x", "y", "height", "yaw_deg")  # in the order of covariances
_PAIRS = [(i, j) for i in range(4) for j in range(i, 4)]
_COLUMNS = ("frame", "name", "source_frame", "timestamp", "x", "y", "yaw_deg", "height")


def path_as_svg(path: Trajectory, unit_name: str = "heights") -> str:
    """The path seen from above, x to the right and y downwards, with arrows where the camera heads; as SVG.

    ``unit_name`` is that of the positions, for the scale bar.
    """
    low, extent = path.position.min(axis=0), np.ptp(path.position, axis=0)
    unit = _SIDE / max(float(extent.max()), 1e-12)
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
    scale = 10.0 ** np.floor(np.log10(max(float(extent.max()), 1e-12)))
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" font-family="sans-serif">
<defs><marker id="tip" markerWidth="6" markerHeight="6" refX="3" refY="3" orient="auto">
<path d="M0,1 L5,3 L0,5 z" fill="#c33"/></marker></defs>
<rect width="100%" height="100%" fill="white"/>
<polyline points="{line}" fill="none" stroke="#236" stroke-width="2"/>
<g stroke="#c33" stroke-width="1.2">{arrows}</g>
<circle cx="{points[0, 0]:.1f}" cy="{points[0, 1]:.1f}" r="5" fill="#2a2"/>
<path d="M20,{height - 20:.1f} h{scale * unit:.1f}" stroke="black" stroke-width="2"/>
<text x="20" y="{height - 26:.1f}" font-size="14">{scale:g} {unit_name}</text>
</svg>
"""


def frame_of(layout: str) -> TrajectoryFrame:
    """The frame of reference of a format where none is asked for: KITTI's axes are the camera's."""
    axes: dict[str, TrajectoryFrame] = {"kitti": "camera", "bag": "ros"}
    return axes.get(layout, "enu")


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
    half = heading(path, frame) / 2
    rows = zip(times_or_numbers(path), positions_in_frame(path, frame), np.sin(half), np.cos(half), strict=True)
    lines = [f"{time:.6f} {x:.9g} {y:.9g} {z:.9g} 0 0 {qz:.9g} {qw:.9g}" for time, (x, y, z), qz, qw in rows]
    return "\n".join(lines) + "\n"


def as_kitti(path: Trajectory, frame: TrajectoryFrame) -> str:
    """Lines of the 12 numbers of ``[R t]``, row by row; frames that were left out have no line."""
    lines = []
    for (x, y, z), turn in zip(positions_in_frame(path, frame), heading(path, frame), strict=True):
        c, s = np.cos(turn), np.sin(turn)
        pose = (c, -s, 0.0, x, s, c, 0.0, y, 0.0, 0.0, 1.0, z)
        lines.append(" ".join(f"{value:.9g}" for value in pose))
    return "\n".join(lines) + "\n"


def heading(path: Trajectory, frame: TrajectoryFrame) -> FloatArray:
    """Turn of the camera about z (F,), radians."""
    return np.asarray(-turn_about_z(frame) * path.yaw)


def positions_in_frame(path: Trajectory, frame: TrajectoryFrame) -> FloatArray:
    """x, y and z of the camera, shape (F, 3)."""
    return np.column_stack([path.position @ AXES[frame].T, -turn_about_z(frame) * path.height]) + 0.0  # no minus zero


def has_times(path: Trajectory) -> bool:
    """Check whether every frame has a time stamp."""
    return path.timestamp is not None and bool(np.isfinite(path.timestamp).all())


def times_or_numbers(path: Trajectory) -> FloatArray:
    """Time stamps (F,), or numbers of frames where not every one has a time."""
    return np.asarray(path.timestamp if has_times(path) else path.frame)


WRITERS: dict[str, Callable[[Trajectory, TrajectoryFrame], str]] = {"csv": as_csv, "tum": as_tum, "kitti": as_kitti}
"""By the name of the format."""
