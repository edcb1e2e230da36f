"""When each picture was taken: as a file says, its video or bag, or its EXIF."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.errors import InputError
from rdstitch.inputs.source import Source
from rdstitch.records import read_text

_HEADER = ("name", "timestamp")


def timestamps_of(sources: Sequence[Source], file: str | Path | None = None) -> FloatArray:
    """Time stamps (N,), s; NaN where nothing is known.

    Without a file, that of the video (from its beginning) or bag, else that of EXIF (since 1970, in UTC where EXIF has
    no time zone).

    Parameters
    ----------
    sources : sequence of Source
    file : path, optional
        CSV with a header that names the columns ``name`` and ``timestamp``; or lines ``TIMESTAMP NAME`` as in the lists
        of the TUM benchmark; or one time a line, the n-th for the n-th picture or frame of the video, as KITTI's
        ``times.txt``. Lines that begin with ``#`` are ignored.

    Raises
    ------
    InputError
        When the file cannot be read, or has no time for a picture.
    """
    if file is None:
        return np.array([_own(source) for source in sources])
    lines = [line.strip() for line in read_text(file).splitlines()]
    lines = [line for line in lines if line and not line.startswith("#")]
    if lines and all(_is_number(line) for line in lines):
        return _by_number(sources, [float(line) for line in lines], file)
    named = _by_name(lines, file)
    for source in sources:
        if source.name not in named:
            raise InputError(f"{file}: has no time for {source.name}; add a line with its name and time")
    return np.array([named[source.name] for source in sources])


def _own(source: Source) -> float:
    if source.frame is not None and source.frame.timestamp is not None:
        return source.frame.timestamp
    return math.nan if source.metadata.timestamp is None else source.metadata.timestamp


def _by_number(sources: Sequence[Source], times: Sequence[float], file: str | Path) -> FloatArray:
    """One time for each picture in order, or for each frame of the video that pictures were taken from."""
    numbers = [source.number(position) for position, source in enumerate(sources)]
    if max(numbers) >= len(times):
        raise InputError(f"{file}: has {len(times)} times, but picture or frame {max(numbers)} (from 0) needs one")
    return np.array([times[number] for number in numbers])


def _by_name(lines: Sequence[str], file: str | Path) -> dict[str, float]:
    if lines and all(name in lines[0] for name in _HEADER):
        rows = [(row["timestamp"], row["name"]) for row in csv.DictReader(lines, skipinitialspace=True)]
    else:
        rows = [(line.split(maxsplit=1)[0], line.split(maxsplit=1)[-1]) for line in lines]
    times: dict[str, float] = {}
    for time, name in rows:
        if not name or not _is_number(time):
            raise InputError(f"{file}: expected a time and a name in each line, found {time!r} and {name!r}")
        times[Path(name).name] = float(time)
    return times


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
