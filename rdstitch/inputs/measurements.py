"""What was measured of each image besides: tilt, place and time, by the image's metadata or a table."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.errors import InputError
from rdstitch.geometry.crs import Crs
from rdstitch.geometry.exif_orientation import turning_matrix
from rdstitch.geometry.planar_motion import tilt_from_normal, turned_tilt
from rdstitch.inputs.frame import Frame
from rdstitch.inputs.source import Source
from rdstitch.inputs.tables import Row, by_image, csv_rows
from rdstitch.io.metadata import GpsPosition
from rdstitch.results.messages import shortened
from rdstitch.system.file_access import canonical_name, file_state, read_text

XMP = "xmp"
"""The value of ``attitude`` that stands for the images' own XMP."""

_NAMES = "name filename file image imagename"
_TIME = "timestamp time stamp"
_TILT_COLUMNS = {"name": _NAMES, "timestamp": _TIME} | {name: name for name in ("psi", "theta", "qx", "qy", "qz", "qw")}
_MAX_TILT = math.radians(80.0)  # beyond, hardly an image shows ground, and more likely angles mean something else
_TIME_COLUMNS = {"name": _NAMES, "timestamp": _TIME}


def with_attitudes(sources: Sequence[Source], wanted: str | Path | None) -> list[Source]:
    """The sources, each with its attitude, if these are wanted.

    By :data:`XMP`: what drones write into images, see :mod:`rdstitch.io.attitude`; the plane is then taken to be level.
    Or by a CSV file with the columns ``name`` (of the image's file), ``psi`` and ``theta``, degrees; or ``timestamp``,
    s, instead of the name, between which is interpolated; or the quaternion ``qx``, ``qy``, ``qz``, ``qw`` of a body of
    ROS instead of the angles.
    """
    if wanted is None:
        return list(sources)
    attitudes = _of_images(sources) if wanted == XMP else _of_table(sources, wanted)
    return [replace(source, attitude=attitude) for source, attitude in zip(sources, attitudes, strict=True)]


def _of_images(sources: Sequence[Source]) -> list[tuple[float, float]]:
    """(ψ, θ), radians, of each source by its XMP."""
    tilts, lacking = [], []
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
        tilts.append((psi, theta))
    if lacking:
        raise InputError(
            f"{shortened(lacking)}: no attitude of the camera can be read from the XMP; give a CSV file instead"
        )
    return tilts


def _of_table(sources: Sequence[Source], file: str | Path) -> list[tuple[float, float]]:
    """(ψ, θ), radians, of each source by its line, or by its time."""
    table = _read_attitudes(file, file_state(file))
    return [turned_tilt(table.of(source, file), turning_matrix(source.metadata.orientation)) for source in sources]


@dataclass(frozen=True)
class _AttitudeTable:
    """Attitudes (ψ, θ), radians, by the names of images, or by time as an IMU measures them at its own rate."""

    named: Mapping[str, tuple[float, float]]
    times: FloatArray  # (M,), s, ascending; empty where they are by name
    tilts: FloatArray  # (M, 2)

    def of(self, source: Source, file: str | Path) -> tuple[float, float]:
        """Of one image; between two times interpolated."""
        if not len(self.times):
            if source.name not in self.named:
                raise InputError(f"{file}: has no line for {source.name}; add one with its psi and theta")
            return self.named[source.name]
        time = float(timestamps_of([source])[0])
        first, last = self.times[[0, -1]].tolist()
        beyond = float(np.median(np.diff(self.times))) if len(self.times) > 1 else 0.0
        if math.isnan(time):
            raise InputError(f"{source.path}: has no time, and {file} has attitudes by time; give --timestamps")
        if not first - beyond <= time <= last + beyond:
            raise InputError(
                f"{file}: has attitudes from {first:.3f} to {last:.3f} s, not for {source.name}, {time:.3f} s"
            )
        psi, theta = (float(np.interp(time, self.times, values)) for values in self.tilts.T)
        return psi, theta


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


def positions_of(sources: Sequence[Source]) -> FloatArray:
    """Metres east and north (N, 2) of the median of the images' GPS positions; NaN where unknown."""
    return metres_around_median([source.metadata.gps for source in sources])


def metres_around_median(known: Sequence[GpsPosition | None]) -> FloatArray:
    """Metres east and north (N, 2) of the median of positions, on a conformal map; NaN where unknown."""
    degrees = [(np.nan, np.nan) if gps is None else (gps.latitude, gps.longitude) for gps in known]
    latitude, longitude = np.array(degrees, dtype=np.float64).reshape(-1, 2).T
    if not (places := np.isfinite(latitude)).any():
        return np.full((len(known), 2), np.nan)
    metres = np.full((len(known), 2), np.nan)
    metres[places] = Crs.nearest(latitude[places], longitude[places]).project(latitude[places], longitude[places])
    metres[~np.isfinite(metres).all(axis=1)] = np.nan
    around: FloatArray = metres - np.nanmedian(metres, axis=0)
    return around


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


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
