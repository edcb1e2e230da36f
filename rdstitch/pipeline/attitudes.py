"""The tilt of each picture, as a gimbal or an IMU has measured it."""

import csv
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rdstitch.errors import InputError
from rdstitch.pipeline.sources import Source
from rdstitch.records import read_text

_COLUMNS = ("name", "psi", "theta")


def with_attitudes(sources: Sequence[Source], file: str | Path | None) -> list[Source]:
    """The sources, each with its attitude, if there is a file of them.

    Parameters
    ----------
    sources : sequence of Source
    file : path or None
        CSV with a header that names the columns ``name`` (of the picture's file), ``psi`` and ``theta``, degrees;
        others are ignored.

    Raises
    ------
    InputError
        When the file cannot be read, is no such table, or has no line for a picture.
    """
    if file is None:
        return list(sources)
    attitudes = _attitudes(file)
    for source in sources:
        if source.name not in attitudes:
            raise InputError(f"{file}: has no line for {source.name}; add one with its psi and theta")
    return [replace(source, attitude=attitudes[source.name]) for source in sources]


def _attitudes(file: str | Path) -> dict[str, tuple[float, float]]:
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
