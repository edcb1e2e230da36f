"""Trajectories as files: a table, and the formats of the TUM and KITTI benchmarks, which ``evo`` reads.

In the latter two the plane lies at z = 0 and z points into it, away from the camera, which therefore is at minus its
height. The orientation is that of the camera with its tilt removed, ``Rz(-φ)``: from the frame of the camera to the
plane's.
"""

import csv
import io
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.alignment.trajectory import Trajectory
from rdstitch.errors import ArgumentError

_COLUMNS = ("frame", "name", "source_frame", "timestamp", "x", "y", "phi_deg", "height")


def as_csv(path: Trajectory) -> str:
    """A table with a header; what is not known of a frame is empty."""
    count = len(path)
    names = path.name or ("",) * count
    numbers = path.frame if path.source_frame is None else path.source_frame
    times = np.full(count, np.nan) if path.timestamp is None else path.timestamp
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(_COLUMNS)
    rows = zip(path.frame, names, numbers, times, path.position, np.degrees(path.yaw), path.height, strict=True)
    for frame, name, number, time, (x, y), yaw, height in rows:
        seconds = f"{time:.6f}" if np.isfinite(time) else ""
        table.writerow([frame, name, number, seconds, *(f"{value:.9g}" for value in (x, y, yaw, height))])
    return text.getvalue()


def as_tum(path: Trajectory, timestamps: ArrayLike | None = None) -> str:
    """Lines ``timestamp tx ty tz qx qy qz qw``.

    Parameters
    ----------
    path : Trajectory
    timestamps : array_like of shape (F,), optional
        s. Without them the path's own; without these, numbers of frames stand for them.

    Raises
    ------
    ArgumentError
        When the number of time stamps is not that of the frames.
    """
    if timestamps is None:
        timestamps = path.timestamp if has_times(path) else path.frame
    times = np.asarray(timestamps, dtype=np.float64)
    if times.shape != path.frame.shape:
        raise ArgumentError(f"expected {len(path)} timestamps, not an array of shape {times.shape}")
    half = -path.yaw / 2
    rows = zip(times, path.position, path.height, np.sin(half), np.cos(half), strict=True)
    lines = [f"{time:.6f} {x:.9g} {y:.9g} {-height:.9g} 0 0 {qz:.9g} {qw:.9g}" for time, (x, y), height, qz, qw in rows]
    return "\n".join(lines) + "\n"


def as_kitti(path: Trajectory) -> str:
    """Lines of the 12 numbers of ``[R t]``, row by row; frames that were left out have no line."""
    lines = []
    for (x, y), yaw, height in zip(path.position, path.yaw, path.height, strict=True):
        c, s = np.cos(yaw), np.sin(yaw)
        pose = (c, s, 0.0, x, -s, c, 0.0, y, 0.0, 0.0, 1.0, -height)
        lines.append(" ".join(f"{value:.9g}" for value in pose))
    return "\n".join(lines) + "\n"


def has_times(path: Trajectory) -> bool:
    """Whether every frame has a time stamp."""
    return path.timestamp is not None and bool(np.isfinite(path.timestamp).all())


WRITERS: dict[str, Callable[[Trajectory], str]] = {"csv": as_csv, "tum": as_tum, "kitti": as_kitti}
"""By the name of the format."""
