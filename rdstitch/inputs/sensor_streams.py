"""What sensors say at times of their own, as the images need it: times, attitudes, odometry.

Values are interpolated between two times of a sensor. Its clock may be late against the camera's: what depends on that
is kept for a range of delays, :data:`DELAYS`, among which the images choose.
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.errors import InputError
from rdstitch.geometry.exif_orientation import turning_matrix
from rdstitch.geometry.planar_motion import tilt_from_normal, turned_tilt
from rdstitch.inputs.frame import Frame
from rdstitch.inputs.source import Source
from rdstitch.inputs.tables import Row, by_image, csv_rows
from rdstitch.results.messages import shortened
from rdstitch.system.file_access import canonical_name, file_state, read_text

XMP = "xmp"
"""The value of ``attitude`` that stands for the images' own XMP."""

DELAYS = np.linspace(-0.3, 0.3, 61)
"""Seconds by which a sensor's times may be later than those of the images."""

DELAY_STD = 0.05
"""Seconds: what is to be expected of that; buses and drivers of IMUs take milliseconds, queues tenths of a second."""

_POLYNOMIALS = np.linalg.qr(np.vander(DELAYS / DELAYS[-1], 6))[0]
_SLOW = _POLYNOMIALS @ _POLYNOMIALS.T
_NAMES = "name filename file image imagename"
_TIME = "timestamp time stamp"
_TILT_COLUMNS = {"name": _NAMES, "timestamp": _TIME} | {name: name for name in ("psi", "theta", "qx", "qy", "qz", "qw")}
_TIME_COLUMNS = {"name": _NAMES, "timestamp": _TIME}
_ODOMETRY_COLUMNS = {"timestamp": _TIME} | {
    name: name.replace("_", "")
    for name in ("x", "y", "yaw", "yaw_deg", "qx", "qy", "qz", "qw", "cov_x_x", "cov_y_y", "cov_yaw_deg_yaw_deg")
}
# What wheels are off by if they do not say: a share of distances and turns, and of a body at rest, metres and radians.
_SLIP, _STANDING = 0.02, 1e-4
_MAX_TILT = math.radians(80.0)  # beyond, hardly an image shows ground, and more likely angles mean something else


def at_delay(values: FloatArray, delay: float) -> FloatArray:
    """Of values (..., S, D) at :data:`DELAYS` those (..., D) at one delay, between which they change evenly."""
    place = float(np.clip(np.interp(delay, DELAYS, np.arange(len(DELAYS))), 0.0, len(DELAYS) - 1.0))
    low = min(int(place), len(DELAYS) - 2)
    return np.asarray(values[..., low, :] + (place - low) * (values[..., low + 1, :] - values[..., low, :]))


def smooth(values: FloatArray) -> FloatArray:
    """The slow part of values (..., S, D) at :data:`DELAYS`: noise must not decide on the delay."""
    return np.asarray(np.einsum("st,...td->...sd", _SLOW, values))


def change_with_delay(values: FloatArray) -> FloatArray:
    """Root mean square change (..., D) a second of values (..., S, D) within the usual delays."""
    usual = np.abs(DELAYS) <= DELAY_STD
    change = np.gradient(smooth(values), DELAYS, axis=-2)[..., usual, :]
    return np.asarray(np.sqrt(np.mean(change**2, axis=-2)))


def timestamps_of(sources: Sequence[Source]) -> FloatArray:
    """Time stamps (N,), s; NaN where nothing is known.

    That of a table, see :func:`with_times`, or of the video (from its beginning) or bag, else that of EXIF (since 1970,
    in UTC where EXIF has no time zone).
    """
    own = [(None if source.frame is None else source.frame.timestamp) for source in sources]
    times = [s.metadata.timestamp if known is None else known for s, known in zip(sources, own, strict=True)]
    return np.array([math.nan if time is None else time for time in times])


def with_times(frames: Sequence[Frame], file: str | Path | None) -> list[Frame]:
    """Everything that was named, each with its time by a file; before anything of it is left out.

    The file is a CSV with the columns ``name`` and ``timestamp``; or has lines ``TIMESTAMP NAME`` as in the lists of
    the TUM benchmark; or one time a line, the n-th for the n-th image or frame of the video, as KITTI's ``times.txt``.
    Lines that begin with ``#`` are ignored.
    """
    if file is None:
        return list(frames)
    named = _read_times(file, file_state(file))
    if not isinstance(named, list):
        return [replace(frame, timestamp=_time_of(frame, named, file)) for frame in frames]
    numbers = np.array([position if frame.number is None else frame.number for position, frame in enumerate(frames)])
    if len(np.unique(numbers)) < len(numbers):  # of several videos
        numbers = np.arange(len(frames))
    steps = np.unique(np.diff(np.sort(numbers)))
    # Of every n-th frame of a video up to n - 1 may follow the last; of chosen ones, any number.
    most = numbers.max() + steps[0] if len(steps) == 1 else math.inf if len(steps) else 1
    if not numbers.max() < len(named) <= most:
        last = f" or frames, the last with the number {numbers.max()} from 0" if most != len(frames) else ""
        raise InputError(f"{file}: has {len(named)} times for {len(frames)} images{last}; give one for each, in order")
    return [replace(frame, timestamp=named[number]) for frame, number in zip(frames, numbers.tolist(), strict=True)]


def time_of(frame: Frame, file: str | Path) -> float | None:
    """The same of one frame, by its number or name; None where a file that grows as the frames do has no time yet."""
    try:
        named = _read_times(file, file_state(file))
        if isinstance(named, list):
            return named[frame.number] if frame.number is not None and frame.number < len(named) else None
        return _time_of(frame, named, file)
    except InputError:
        return None


def _time_of(frame: Frame, named: dict[str, float], file: str | Path) -> float:
    name = canonical_name(frame.path.name)
    if name not in named:
        raise InputError(f"{file}: has no time for {name}; add a line with its name and time")
    return named[name]


@lru_cache(maxsize=1)  # frames that are followed ask one after the other
def _read_times(file: str | Path, state: tuple[int, int] | None) -> list[float] | dict[str, float]:
    """The times in order, or by the names of the images, of a file in a state."""
    text, where = read_text(file), str(file)
    lines = [(n, line.strip()) for n, line in enumerate(text.splitlines(), start=1)]
    lines = [(n, line) for n, line in lines if line and not line.startswith("#")]
    if lines and all(_is_number(line) for _, line in lines):
        return [float(line) for _, line in lines]
    if not lines or not _is_number(lines[0][1].split()[0]):
        rows = csv_rows(text, where, _TIME_COLUMNS, ("name,timestamp",), ("s",))
    else:
        rows = []
        for number, line in lines:
            time, name = (*line.split(maxsplit=1), "")[:2]
            if not name or not _is_number(time):
                wanted = f"a table with the columns {','.join(_TIME_COLUMNS)}, lines TIMESTAMP NAME, or one time a line"
                raise InputError(f"{file}: line {number}: found '{line}'; give {wanted}")
            rows.append(Row(f"{file}: line {number}", {"name": name, "timestamp": time}, "."))
    return {name: row.needed("timestamp") for name, row in by_image(rows).items()}


def with_attitudes(sources: Sequence[Source], wanted: str | Path | None) -> list[Source]:
    """The sources, each with its attitude, if these are wanted.

    By :data:`XMP`: what drones write into images, see :mod:`rdstitch.io.attitude`; the plane is then taken to be level.
    Or by a CSV file with the columns ``name`` (of the image's file), ``psi`` and ``theta``, degrees; or ``timestamp``,
    s, instead of the name, between which is interpolated; or the quaternion ``qx``, ``qy``, ``qz``, ``qw`` of a body of
    ROS instead of the angles.
    """
    if wanted is None:
        return list(sources)
    return _of_images(sources) if wanted == XMP else [_of_table(source, wanted) for source in sources]


def _of_images(sources: Sequence[Source]) -> list[Source]:
    """The sources with (ψ, θ), radians, by their XMP."""
    measured, lacking = [], []
    for source in sources:
        nadir = source.metadata.nadir
        if nadir is None:
            lacking.append(source.name)
            continue
        away = math.acos(nadir[2])
        if away > _MAX_TILT:
            raise InputError(
                f"{source.path}: by its XMP the camera looks {math.degrees(away):.0f} degrees away from straight down; "
                "give a CSV file if that is wrong"
            )
        psi, theta = tilt_from_normal(nadir).tolist()
        measured.append(replace(source, attitude=(psi, theta)))
    if lacking:
        raise InputError(
            f"{shortened(lacking)}: no attitude of the camera can be read from the XMP; give a CSV file instead"
        )
    return measured


def _of_table(source: Source, file: str | Path) -> Source:
    """A source with (ψ, θ), radians, of its line, or of its time, and then at delays too."""
    table, turn = _read_attitudes(file, file_state(file)), turning_matrix(source.metadata.orientation)
    if not len(table.times):
        return replace(source, attitude=turned_tilt(table.of(source, file), turn))
    tilts = [turned_tilt((psi, theta), turn) for psi, theta in table.at(table.time_of(source, file) + DELAYS).tolist()]
    return replace(source, attitude=tilts[len(DELAYS) // 2], attitude_by_delay=np.array(tilts))


@dataclass(frozen=True)
class _AttitudeTable:
    """Attitudes (ψ, θ), radians, by the names of images, or by time as an IMU measures them at its own rate."""

    named: Mapping[str, tuple[float, float]]
    times: FloatArray  # (M,), s, ascending; empty where they are by name
    tilts: FloatArray  # (M, 2)

    def of(self, source: Source, file: str | Path) -> tuple[float, float]:
        """Of one image by its name."""
        if source.name not in self.named:
            raise InputError(f"{file}: has no line for {source.name}; add one with its psi and theta")
        return self.named[source.name]

    def time_of(self, source: Source, file: str | Path) -> float:
        """When an image was taken, which must lie within the table."""
        time = float(timestamps_of([source])[0])
        first, last = self.times[[0, -1]].tolist()
        beyond = float(np.median(np.diff(self.times))) if len(self.times) > 1 else 0.0
        if math.isnan(time):
            raise InputError(f"{source.path}: has no time, and {file} has attitudes by time; give --timestamps")
        if not first - beyond <= time <= last + beyond:
            raise InputError(
                f"{file}: has attitudes from {first:.3f} to {last:.3f} s, not for {source.name}, {time:.3f} s"
            )
        return time

    def at(self, times: FloatArray) -> FloatArray:
        """(ψ, θ) (K, 2) at times (K,), interpolated."""
        return np.stack([np.interp(times, self.times, values) for values in self.tilts.T], axis=1)


@lru_cache(maxsize=1)  # frames that are followed ask one after the other
def _read_attitudes(file: str | Path, state: tuple[int, int] | None) -> _AttitudeTable:
    """The table of a file in a state."""
    wanted = ("name,psi,theta", "timestamp,psi,theta", "timestamp,qx,qy,qz,qw")
    rows = csv_rows(read_text(file), str(file), _TILT_COLUMNS, wanted, ("deg", "degrees", "s"))
    by_name = any("name" in row.values for row in rows)
    tilts = []
    for row in rows:
        psi, theta = _tilt_of(row)
        if not (abs(psi) < math.pi / 2 and abs(theta) < math.pi / 2):
            raise InputError(f"{row.where}: psi and theta must lie between -90 and 90 degrees")
        tilts.append((psi, theta))
    if by_name:
        named = dict(zip(by_image(rows), tilts, strict=True))
        return _AttitudeTable(named, np.empty(0), np.empty((0, 2)))
    times = np.array([row.needed("timestamp") for row in rows])
    order = np.argsort(times, kind="stable")
    return _AttitudeTable({}, times[order], np.array(tilts).reshape(-1, 2)[order])


def _tilt_of(row: Row) -> tuple[float, float]:
    """(ψ, θ), radians, as angles in degrees or as the quaternion of a body of ROS (x ahead, y left, z up).

    The lens of that looks down, and the top of the image is ahead.
    """
    if "qw" not in row.values:
        return math.radians(row.needed("psi")), math.radians(row.needed("theta"))
    x, y, z, w = (row.needed(name) for name in ("qx", "qy", "qz", "qw"))
    if not 0.99 < math.hypot(x, y, z, w) < 1.01:
        raise InputError(f"{row.where}: qx, qy, qz, qw are no unit quaternion")
    # Down in the body's axes, then in the camera's: right, towards the bottom of the image, ahead of the lens.
    ahead, left, up = -2.0 * (x * z - w * y), -2.0 * (y * z + w * x), -(1.0 - 2.0 * (x * x + y * y))
    psi, theta = tilt_from_normal((-left, -ahead, -up)).tolist()
    return psi, theta


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


class BodyPose(NamedTuple):
    """A pose of a body (x ahead, y left), as its wheels have measured it."""

    x: float
    y: float
    yaw: float  # radians, counterclockwise from above
    variance: float = math.nan  # variance, yaw_variance: of a coordinate and of the yaw, since the start; NaN: unknown
    yaw_variance: float = math.nan


class BodyMotion(NamedTuple):
    """How a body has moved, in its axes at the beginning."""

    moved: complex  # ahead, and to the left as the imaginary part
    turn: float  # radians, counterclockwise from above
    variance: float  # of each coordinate
    turn_variance: float


def motion_between(start: BodyPose, end: BodyPose) -> BodyMotion:
    """The motion from one pose to another."""
    moved = complex(end.x - start.x, end.y - start.y) * cmath.exp(-1j * start.yaw)
    turn = math.remainder(end.yaw - start.yaw, math.tau)
    usual = [(_SLIP * abs(size) + _STANDING) ** 2 for size in (moved, turn)]
    stated = [abs(end.variance - start.variance), abs(end.yaw_variance - start.yaw_variance)]
    known = [one if math.isfinite(one) and one > 0.0 else other for one, other in zip(stated, usual, strict=True)]
    return BodyMotion(moved, turn, *known)


@dataclass(frozen=True)
class Odometry:
    """Poses of a body by time."""

    times: FloatArray  # (M,), s, ascending
    poses: FloatArray  # (M, 5): as in BodyPose, the yaw continuous

    def at(self, time: float) -> BodyPose | None:
        """The pose at a time, interpolated; None beyond what was measured."""
        if not self.times[0] <= time <= self.times[-1]:
            return None
        return BodyPose(*(float(np.interp(time, self.times, values)) for values in self.poses.T))


def read_odometry(file: str | Path) -> Odometry:
    """Wheel odometry of a file: TUM's lines, or a CSV table of ``timestamp,x,y,yaw_deg`` as ``trajectory`` writes it.

    Covariances ``cov_x_x``, ``cov_y_y`` and ``cov_yaw_deg_yaw_deg`` are used where the table has them; instead of the
    yaw it may have a quaternion.
    """
    return _read_odometry(file, file_state(file))


@lru_cache(maxsize=1)  # frames that are followed ask one after the other
def _read_odometry(file: str | Path, state: tuple[int, int] | None) -> Odometry:
    text, where = read_text(file), str(file)
    first = next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
    if len(first.split()) == 8 and all(_is_number(part) for part in first.split()):
        rows = []
        for number, line in enumerate(text.splitlines(), start=1):
            if line.strip() and not line.startswith("#"):
                parts = line.split()
                if len(parts) != 8 or not all(map(_is_number, parts)):
                    raise InputError(f"{file}: line {number}: expected timestamp tx ty tz qx qy qz qw, found '{line}'")
                time, x, y, _, qx, qy, qz, qw = map(float, parts)
                rows.append((time, x, y, yaw_of(qx, qy, qz, qw), math.nan, math.nan))
        return odometry_of(rows, where)
    wanted = ("timestamp,x,y,yaw_deg", "timestamp,x,y,yaw", "timestamp,x,y,qx,qy,qz,qw")
    table = []
    for row in csv_rows(text, where, _ODOMETRY_COLUMNS, wanted, ("s", "m", "deg", "rad")):
        yaw = row.number("yaw")
        if yaw is None and (degrees := row.number("yaw_deg")) is not None:
            yaw = math.radians(degrees)
        if yaw is None:
            yaw = yaw_of(*(row.needed(name) for name in ("qx", "qy", "qz", "qw")))
        x_x, y_y, turn = (row.number(name) for name in ("cov_x_x", "cov_y_y", "cov_yaw_deg_yaw_deg"))
        place = math.nan if x_x is None or y_y is None else (x_x + y_y) / 2.0
        turned = math.nan if turn is None else math.radians(math.sqrt(max(turn, 0.0))) ** 2
        table.append((row.needed("timestamp"), row.needed("x"), row.needed("y"), yaw, place, turned))
    return odometry_of(table, where)


def odometry_of(rows: Sequence[tuple[float, ...]], where: str) -> Odometry:
    """From rows of time, x, y, yaw (radians), and the variances of a coordinate and of the yaw."""
    values = np.array(sorted(rows), dtype=np.float64).reshape(-1, 6)
    values = values[np.append(np.diff(values[:, 0]) > 0.0, True)] if len(values) else values
    if len(values) < 2:
        raise InputError(f"{where}: has no odometry at two times")
    values[:, 3] = np.unwrap(values[:, 3])
    return Odometry(values[:, 0], values[:, 1:])


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """The turn about z of a quaternion, radians."""
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
