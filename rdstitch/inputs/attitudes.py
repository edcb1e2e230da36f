"""Measured tilts of images: of their XMP, of a table by name, or of an IMU by time, between which is interpolated."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.errors import InputError
from rdstitch.geometry.exif_orientation import turning_matrix
from rdstitch.geometry.planar_motion import tilt_from_normal, turned_tilt
from rdstitch.inputs.delays import DELAYS, MeasuredTilt
from rdstitch.inputs.odometry import unit_quaternion
from rdstitch.inputs.rows_of_images import RowsByImage
from rdstitch.inputs.source import Source
from rdstitch.inputs.tables import IMAGE_NAMES, TIME_NAMES, Row, csv_rows
from rdstitch.inputs.time_gaps import in_gap
from rdstitch.inputs.times import timestamps_of
from rdstitch.results.messages import shortened
from rdstitch.system.file_access import cached_by_file_state, read_text

XMP = "xmp"
"""The value of ``attitude`` that stands for the images' own XMP."""

_COLUMNS = {name: name for name in ("psi", "theta", "qx", "qy", "qz", "qw")}
_COLUMNS |= {"name": IMAGE_NAMES, "timestamp": TIME_NAMES}
_UNITS = {"timestamp": "s", "psi": "deg degrees", "theta": "deg degrees"}
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
    if wanted == XMP:
        return _of_images(sources)
    attitudes = _read_attitudes(wanted)(sources)
    return [replace(source, attitude=attitude) for source, attitude in zip(sources, attitudes, strict=True)]


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


def _by_name(file: str | Path, rows: RowsByImage, sources: Sequence[Source]) -> list[MeasuredTilt]:
    """Tilts of images, each of which the table must name."""
    return [
        MeasuredTilt(turned_tilt(_tilt_of(row), turning_matrix(source.metadata.orientation)))
        for source, row in zip(sources, rows.needed(sources, file, "psi and theta"), strict=True)
    ]


def _by_time(file: str | Path, times: FloatArray, tilts: FloatArray, sources: Sequence[Source]) -> list[MeasuredTilt]:
    """Tilts of images between those (M, 2) that an IMU has measured at times (M,), s, ascending, at :data:`DELAYS`."""
    first, last = times[[0, -1]].tolist()
    beyond = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    measured = []
    for source, time in zip(sources, timestamps_of(sources).tolist(), strict=True):
        if math.isnan(time):
            raise InputError(f"{source.path}: has no time, and {file} has attitudes by time; give --timestamps")
        if not first - beyond <= time <= last + beyond:
            raise InputError(
                f"{file}: has attitudes from {first:.3f} to {last:.3f} s, not for {source.name}, {time:.3f} s"
            )
        if in_gap(times, np.array([time]))[0]:
            raise InputError(f"{file}: has no attitudes for a long time before and after {source.name}, {time:.3f} s")
        turn = turning_matrix(source.metadata.orientation)
        rows = np.stack([np.interp(time + DELAYS, times, values) for values in tilts.T], axis=1)
        at_delays = [turned_tilt((psi, theta), turn) for psi, theta in rows.tolist()]
        measured.append(MeasuredTilt(at_delays[len(DELAYS) // 2], np.array(at_delays)))
    return measured


@cached_by_file_state
def _read_attitudes(file: str | Path) -> Callable[[Sequence[Source]], list[MeasuredTilt]]:
    wanted = ("name,psi,theta", "timestamp,psi,theta", "timestamp,qx,qy,qz,qw")
    rows = csv_rows(read_text(file), str(file), _COLUMNS, wanted, _UNITS)
    tilts = [_tilt_of(row) for row in rows]
    if any("name" in row.values for row in rows):
        return partial(_by_name, file, RowsByImage(rows))
    times = np.array([row.seconds() for row in rows])
    order = np.argsort(times, kind="stable")
    return partial(_by_time, file, times[order], np.array(tilts).reshape(-1, 2)[order])


def _tilt_of(row: Row) -> tuple[float, float]:
    """(ψ, θ), radians, as angles in degrees or as the quaternion of a body of ROS (x ahead, y left, z up).

    The lens of that looks down, and the top of the image is ahead.
    """
    if "qw" not in row.values:
        psi, theta = row.needed("psi"), row.needed("theta")
        if not (abs(psi) < 90.0 and abs(theta) < 90.0):
            raise InputError(f"{row.where}: psi and theta must lie between -90 and 90 degrees")
        return math.radians(psi), math.radians(theta)
    x, y, z, w = unit_quaternion([row.needed(name) for name in ("qx", "qy", "qz", "qw")], row.where)
    # Down in the body's axes, then in the camera's: right, towards the bottom of the image, ahead of the lens.
    ahead, left, up = -2.0 * (x * z - w * y), -2.0 * (y * z + w * x), -(1.0 - 2.0 * (x * x + y * y))
    psi, theta = tilt_from_normal((-left, -ahead, -up)).tolist()
    return psi, theta
