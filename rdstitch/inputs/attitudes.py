"""The tilt of each picture, as a gimbal or an IMU has measured it."""

import csv
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rdstitch.errors import InputError
from rdstitch.inputs.source import Source
from rdstitch.planar_motion import tilt_from_normal
from rdstitch.records import read_text

XMP = "xmp"
"""The value of ``attitude`` that stands for the pictures' own XMP."""

_COLUMNS = ("name", "psi", "theta")
_MAX_NAMED = 3  # pictures in a message
_MAX_TILT = math.radians(80.0)  # beyond, hardly a picture shows ground, and more likely angles mean something else


def with_attitudes(sources: Sequence[Source], wanted: str | Path | None) -> list[Source]:
    """The sources, each with its attitude, if these are wanted.

    Parameters
    ----------
    sources : sequence of Source
    wanted : str, path or None
        The text :data:`XMP`: what drones write into pictures, see :mod:`rdstitch.io.attitude`; the plane is then taken
        to be level. Or a CSV file with a header that names the columns ``name`` (of the picture's file), ``psi`` and
        ``theta``, degrees; others are ignored.

    Raises
    ------
    InputError
        When the file cannot be read, is no such table, or has no line for a picture; when a picture's XMP has no
        attitude of the camera, or one that is far from looking down.
    """
    if wanted is None:
        return list(sources)
    attitudes = _of_pictures(sources) if wanted == XMP else _of_table(sources, wanted)
    return [replace(source, attitude=attitude) for source, attitude in zip(sources, attitudes, strict=True)]


def _of_pictures(sources: Sequence[Source]) -> list[tuple[float, float]]:
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
        more = f" and {len(lacking) - _MAX_NAMED} more" if len(lacking) > _MAX_NAMED else ""
        named = ", ".join(lacking[:_MAX_NAMED])
        raise InputError(f"{named}{more}: no attitude of the camera can be read from the XMP; give a CSV file instead")
    return tilts


def _of_table(sources: Sequence[Source], file: str | Path) -> list[tuple[float, float]]:
    """(ψ, θ), radians, of each source by its line."""
    table = _read_table(file)
    for source in sources:
        if source.name not in table:
            raise InputError(f"{file}: has no line for {source.name}; add one with its psi and theta")
    return [table[source.name] for source in sources]


def _read_table(file: str | Path) -> dict[str, tuple[float, float]]:
    """(ψ, θ), radians, of each name."""
    rows = csv.DictReader(read_text(file).splitlines(), skipinitialspace=True)
    missing = [name for name in _COLUMNS if name not in (rows.fieldnames or ())]
    if missing:
        raise InputError(f"{file}: has no column {missing[0]!r}; its first line must be {','.join(_COLUMNS)}")
    attitudes: dict[str, tuple[float, float]] = {}
    for row in rows:
        name = row["name"] or ""
        try:
            psi, theta = (math.radians(float(row[column])) for column in _COLUMNS[1:])
        except (TypeError, ValueError):
            raise InputError(f"{file}: line {rows.line_num}: psi and theta must be numbers, in degrees") from None
        if not (abs(psi) < math.pi / 2 and abs(theta) < math.pi / 2):
            raise InputError(f"{file}: line {rows.line_num}: psi and theta must lie between -90 and 90 degrees")
        if name in attitudes:
            raise InputError(f"{file}: line {rows.line_num}: {name} is here twice; remove one")
        attitudes[name] = psi, theta
    return attitudes
