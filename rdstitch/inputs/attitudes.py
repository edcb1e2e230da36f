"""Measured tilts of images: of their XMP, of a table by name, or of an IMU by time, between which is interpolated."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.errors import InputError
from rdstitch.geometry.exif_orientation import turning_matrix
from rdstitch.geometry.planar_motion import tilt_from_normal, turned_tilt
from rdstitch.inputs.delays import DELAYS, MeasuredTilt
from rdstitch.inputs.source import Source
from rdstitch.inputs.tables import IMAGE_NAMES, TIME_NAMES, Row, by_image, csv_rows
from rdstitch.inputs.times import timestamps_of
from rdstitch.results.messages import shortened
from rdstitch.system.file_access import cached_by_file_state, read_text

XMP = "xmp"
"""The value of ``attitude`` that stands for the images' own XMP."""

_COLUMNS = {name: name for name in ("psi", "theta", "qx", "qy", "qz", "qw")}
_COLUMNS |= {"name": IMAGE_NAMES, "timestamp": TIME_NAMES}
_MAX_TILT = math.radians(80.0)  # beyond, hardly an image shows ground, and more likely angles mean something else


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
        measured.append(replace(source, attitude=MeasuredTilt((psi, theta))))
    if lacking:
        raise InputError(
            f"{shortened(lacking)}: no attitude of the camera can be read from the XMP; give a CSV file instead"
        )
    return measured


def _of_table(source: Source, file: str | Path) -> Source:
    """A source with (ψ, θ), radians, of its line, or of its time, and then at delays too."""
    table, turn = _read_attitudes(file), turning_matrix(source.metadata.orientation)
    if not len(table.times):
        return replace(source, attitude=MeasuredTilt(turned_tilt(table.of(source, file), turn)))
    tilts = [turned_tilt((psi, theta), turn) for psi, theta in table.at(table.time_of(source, file) + DELAYS).tolist()]
    return replace(source, attitude=MeasuredTilt(tilts[len(DELAYS) // 2], np.array(tilts)))


@dataclass(frozen=True, eq=False)
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


@cached_by_file_state
def _read_attitudes(file: str | Path) -> _AttitudeTable:
    wanted = ("name,psi,theta", "timestamp,psi,theta", "timestamp,qx,qy,qz,qw")
    rows = csv_rows(read_text(file), str(file), _COLUMNS, wanted, ("deg", "degrees", "s"))
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
        raise InputError(f"{row.where}: qx, qy, qz, qw are not a unit quaternion")
    # Down in the body's axes, then in the camera's: right, towards the bottom of the image, ahead of the lens.
    ahead, left, up = -2.0 * (x * z - w * y), -2.0 * (y * z + w * x), -(1.0 - 2.0 * (x * x + y * y))
    psi, theta = tilt_from_normal((-left, -ahead, -up)).tolist()
    return psi, theta
