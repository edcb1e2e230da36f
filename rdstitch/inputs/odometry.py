"""Poses of a robot's body by its wheels."""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.errors import InputError
from rdstitch.inputs.tables import TIME_NAMES, csv_rows, is_number, numbered_lines, seconds_of
from rdstitch.inputs.time_gaps import in_gap
from rdstitch.system.file_access import cached_by_file_state, read_text

_COLUMNS = {"timestamp": TIME_NAMES} | {
    name: name.replace("_", "")
    for name in ("x", "y", "yaw", "yaw_deg", "qx", "qy", "qz", "qw", "cov_x_x", "cov_y_y", "cov_yaw_deg_yaw_deg")
}
_UNITS = {"timestamp": "s", "x": "m", "y": "m", "yaw": "rad", "yaw_deg": "deg"}
_UNITS |= {"cov_x_x": "m m2 m²", "cov_y_y": "m m2 m²", "cov_yaw_deg_yaw_deg": "deg deg2 deg²"}
_LISTED = 8  # numbers in TUM's lines
_SLIP = 0.02  # fraction of distances and turns that wheels are off by if they do not say


class BodyPose(NamedTuple):
    """A pose of a body (x ahead, y left), as its wheels have measured it."""

    x: float
    y: float
    yaw: float  # radians, counterclockwise from above
    variance: float = math.nan  # variance, yaw_variance: of a coordinate and of the yaw, since the start; NaN: unknown
    yaw_variance: float = math.nan


class BodyMotion(NamedTuple):
    """Motion of a body, in its axes at the beginning."""

    moved: complex  # ahead, and to the left as the imaginary part
    turn: float  # radians, counterclockwise from above
    variance: float  # of each coordinate
    turn_variance: float


def motion_between(start: BodyPose, end: BodyPose) -> BodyMotion:
    """The motion from one pose to another."""
    moved = complex(end.x - start.x, end.y - start.y) * cmath.exp(-1j * start.yaw)
    turn = math.remainder(end.yaw - start.yaw, math.tau)
    usual = [(_SLIP * abs(size)) ** 2 for size in (moved, turn)]
    stated = [abs(end.variance - start.variance), abs(end.yaw_variance - start.yaw_variance)]
    known = [one if math.isfinite(one) and one > 0.0 else other for one, other in zip(stated, usual, strict=True)]
    return BodyMotion(moved, turn, *known)


@dataclass(frozen=True, eq=False)
class Odometry:
    """Poses of a body by time."""

    times: FloatArray  # (M,), s, ascending
    poses: FloatArray  # (M, 5): as in BodyPose, the yaw continuous
    name: str  # of its file, or topic

    def at(self, time: float) -> BodyPose | None:
        """The pose at a time, interpolated; None beyond what was measured, and in gaps."""
        if not self.times[0] <= time <= self.times[-1] or in_gap(self.times, np.array([time]))[0]:
            return None
        return BodyPose(*(float(np.interp(time, self.times, values)) for values in self.poses.T))


def as_odometry(given: "Odometry | str | Path | None") -> Odometry | None:
    """The odometry that is given, of a file what it holds now."""
    return given if given is None or isinstance(given, Odometry) else read_odometry(given)


@cached_by_file_state
def read_odometry(file: str | Path) -> Odometry:
    """Wheel odometry of a file: TUM's lines, or a CSV table of ``timestamp,x,y,yaw_deg`` as ``trajectory`` writes it.

    Covariances ``cov_x_x``, ``cov_y_y`` and ``cov_yaw_deg_yaw_deg`` are used where the table has them; instead of the
    yaw it may have a quaternion.
    """
    text, where = read_text(file), str(file)
    lines = numbered_lines(text, where)
    first = lines[0][1] if lines else ""
    if len(first.split()) == _LISTED and is_number(first.split()[0]) and not set(",;") & set(first):
        return odometry_of([_listed_pose(*line) for line in lines], where)
    wanted = ("timestamp,x,y,yaw_deg", "timestamp,x,y,yaw", "timestamp,x,y,qx,qy,qz,qw")
    table = []
    for row in csv_rows(text, where, _COLUMNS, wanted, _UNITS):
        yaw = row.number("yaw")
        if yaw is None and (degrees := row.number("yaw_deg")) is not None:
            yaw = math.radians(degrees)
        if yaw is None:
            yaw = yaw_of(unit_quaternion([row.needed(name) for name in ("qx", "qy", "qz", "qw")], row.where))
        x_x, y_y, turn = (row.number(name) for name in ("cov_x_x", "cov_y_y", "cov_yaw_deg_yaw_deg"))
        place = math.nan if x_x is None or y_y is None else (x_x + y_y) / 2.0
        turned = math.nan if turn is None else math.radians(math.sqrt(max(turn, 0.0))) ** 2
        table.append((row.seconds(), row.needed("x"), row.needed("y"), yaw, place, turned))
    return odometry_of(table, where)


def _listed_pose(where: str, line: str) -> tuple[float, ...]:
    parts = line.split()
    if len(parts) != _LISTED or not all(map(is_number, parts)):
        raise InputError(f"{where}: expected timestamp tx ty tz qx qy qz qw, found '{line}'")
    time, x, y, _, *turn = map(float, parts)
    return seconds_of(time, where), x, y, yaw_of(unit_quaternion(turn, where)), math.nan, math.nan


def odometry_of(rows: Sequence[tuple[float, ...]], where: str) -> Odometry:
    """Odometry from rows of time, x, y, yaw (radians), and the variances of a coordinate and of the yaw."""
    # Of several at one time the last counts.
    values = np.array(sorted(rows, key=lambda row: row[0]), dtype=np.float64).reshape(-1, 6)
    values = values[np.append(np.diff(values[:, 0]) > 0.0, True)] if len(values) else values
    if len(values) < 2:
        raise InputError(f"{where}: has no odometry at two times")
    values[:, 3] = np.unwrap(values[:, 3])
    return Odometry(values[:, 0], values[:, 1:], where)


def unit_quaternion(parts: Sequence[float], where: str) -> tuple[float, float, float, float]:
    """A quaternion x, y, z, w as a file has it, which must be one of a rotation."""
    if not 0.99 < (length := math.hypot(*parts)) < 1.01:
        raise InputError(f"{where}: {', '.join(f'{part:g}' for part in parts)} is not a unit quaternion")
    x, y, z, w = (part / length for part in parts)
    return x, y, z, w


def yaw_of(quaternion: tuple[float, float, float, float]) -> float:
    """The turn about z of a unit quaternion, radians."""
    x, y, z, w = quaternion
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
