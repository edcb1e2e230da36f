"""Times at which images were taken: by a file, else by the video, the bag or EXIF."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.errors import InputError
from rdstitch.inputs.frame import Frame, frame_numbers
from rdstitch.inputs.rows_of_images import RowsByImage
from rdstitch.inputs.source import Source
from rdstitch.inputs.tables import IMAGE_NAMES, TIME_NAMES, Row, csv_rows, is_number, numbered_lines, seconds_of
from rdstitch.system.file_access import cached_by_file_state, read_text

_COLUMNS = {"name": IMAGE_NAMES, "timestamp": TIME_NAMES}


def timestamps_of(sources: Sequence[Source]) -> FloatArray:
    """Time stamps (N,), s; NaN where nothing is known.

    That of a table, see :func:`with_times`, or of the video (from its beginning) or bag, else that of EXIF (since 1970,
    in UTC where EXIF has no time zone).
    """
    of_frames = [(None if source.frame is None else source.frame.timestamp) for source in sources]
    times = [s.metadata.timestamp if known is None else known for s, known in zip(sources, of_frames, strict=True)]
    return np.array([math.nan if time is None else time for time in times])


def with_times(frames: Sequence[Frame], file: str | Path | None) -> list[Frame]:
    """Everything that was named, each with its time by a file; before anything of it is left out.

    The file is a CSV with the columns ``name`` and ``timestamp``; or has lines ``TIMESTAMP NAME`` as in the lists of
    the TUM benchmark; or one time a line, the n-th for the n-th image or frame of the video, as KITTI's ``times.txt``.
    Lines that begin with ``#`` are ignored.
    """
    if file is None or not frames:
        return list(frames)
    known = _read_times(file)
    times = _by_name(known, frames, file) if isinstance(known, RowsByImage) else _by_number(known, frames, file)
    return [replace(frame, timestamp=time) for frame, time in zip(frames, times, strict=True)]


def time_of(frame: Frame, file: str | Path) -> float | None:
    """Time of one frame by a file that may grow as the frames do; None where it has none yet."""
    with suppress(InputError):
        known = _read_times(file)
        if isinstance(known, RowsByImage):
            return _by_name(known, [frame], file)[0]
        if frame.number is not None and frame.number < len(known):
            return known[frame.number]
    return None


def _by_name(rows: RowsByImage, frames: Sequence[Frame], file: str | Path) -> list[float]:
    return [row.seconds() for row in rows.needed(frames, file, "time")]


def _by_number(times: Sequence[float], frames: Sequence[Frame], file: str | Path) -> list[float]:
    """Times of all images, in their order or that of the frames of a video, of which there must be as many."""
    numbers = np.array(frame_numbers(frames))
    if len(np.unique(numbers)) < len(numbers):  # of several videos
        numbers = np.arange(len(frames))
    steps = np.unique(np.diff(np.sort(numbers)))
    # Of every n-th frame of a video up to n - 1 may follow the last; of chosen ones, and of one, any number.
    of_video = frames[0].number is not None and frames[0].image is None
    most = numbers.max() + steps[0] if len(steps) == 1 else math.inf if len(steps) or of_video else 1
    if not numbers.max() < len(times) <= most:
        last = f" or frames, the last with the number {numbers.max()} from 0" if most != len(frames) else ""
        counted = f"{len(times)} times for {len(frames)} images{last}"
        raise InputError(f"{file}: has {counted}; give one for each, in order")
    return [times[number] for number in numbers.tolist()]


@cached_by_file_state
def _read_times(file: str | Path) -> list[float] | RowsByImage:
    """Times in the order of the images, or by their names."""
    text = read_text(file)
    lines = numbered_lines(text, str(file))
    if lines and all(is_number(line) for _, line in lines):
        return [seconds_of(float(line), where) for where, line in lines]
    if not lines or not is_number(lines[0][1].split()[0]):
        rows = csv_rows(text, str(file), _COLUMNS, ("name,timestamp",), {"timestamp": "s"})
    else:
        rows = []
        for where, line in lines:
            time, name = (*line.split(maxsplit=1), "")[:2]
            if not name or not is_number(time):
                wanted = f"a table with the columns {','.join(_COLUMNS)}, lines TIMESTAMP NAME, or one time a line"
                raise InputError(f"{where}: found '{line}'; give {wanted}")
            rows.append(Row(where, {"name": name, "timestamp": time}, "."))
    return RowsByImage(rows)
