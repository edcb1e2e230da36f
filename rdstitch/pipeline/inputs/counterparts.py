"""Assigning given images to registered ones: by name, by the varying part of names, by time, or by position."""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.choices import MatchBy
from rdstitch.errors import InputError
from rdstitch.geometry.places import GpsPosition
from rdstitch.inputs.frame import Frame, files_of
from rdstitch.inputs.positions import metres_around_median
from rdstitch.io.metadata import read_metadata
from rdstitch.io.opening import check_readable
from rdstitch.numerics.nearest_points import nearest_points
from rdstitch.results.messages import Message, names_of, shortened
from rdstitch.sidecar.read import SavedRegistration
from rdstitch.sidecar.records import MatchedBy
from rdstitch.system.file_access import canonical_name, canonical_text, without_query

_TOKEN = re.compile(r"\d+|[^\W\d_]+|[\W_]+")

Chosen = list[Frame | None]
"""For each image of the registration the frame that takes its place."""


@dataclass(frozen=True)
class Counterparts:
    """Which frames take the places of registered images."""

    chosen: Chosen
    matched: MatchedBy  # by what they were found
    unused: Sequence[Message] = ()  # on frames that take no place


def find_counterparts(saved: SavedRegistration, frames: Sequence[Frame], match: MatchBy) -> Counterparts:
    """Find the frame that takes the place of each registered image."""
    # Arrays have no names of their own.
    if match == "order" or all(frame.image is not None for frame in frames):
        return Counterparts(list(_by_order(saved, frames)), "order")
    if match == "auto":  # read once, for whoever takes the frame
        frames = [_with_header(frame) for frame in frames]
    for matched, find in _BY_NAMES if match == "name" else (*_BY_NAMES, *_BY_HEADERS):
        of_all = find(saved, frames) or [None] * len(saved.images)
        chosen = [frame if image.used else None for image, frame in zip(saved.images, of_all, strict=True)]
        if any(frame is not None for frame in chosen):
            if matched == "name" and match == "auto":
                _refuse_other_flights(saved, chosen, frames)
            return Counterparts(chosen, matched, _without_counterpart(of_all, frames))
    for path in files_of(frames):
        check_readable(path)
    wanted = next(image.name for image in saved.images if image.used)
    by = "has the name of a registered image" if match == "name" else "fits a registered image by name, time or GPS"
    raise InputError(f"{saved.path}: none of the given images {by} ({wanted}, …); --match order takes them in order")


def _without_counterpart(chosen: Chosen, frames: Sequence[Frame]) -> list[Message]:
    taken = {id(frame) for frame in chosen}
    extra = [str(frame.path) for frame in frames if id(frame) not in taken]
    if not extra:
        return []
    who = "has" if len(extra) == 1 else f"{len(extra)} of the given images ({shortened(names_of(extra))}) have"
    return [Message(f"{who} no counterpart among those registered, and is not used", tuple(extra))]


def _by_name(saved: SavedRegistration, frames: Sequence[Frame], key: Callable[[Path], str]) -> Chosen:
    given: dict[str, list[Frame]] = {}
    for frame in frames:
        given.setdefault(canonical_name(key(without_query(frame.path))), []).append(frame)
    chosen, taken = list[Frame | None](), set[int]()
    for image in saved.images:
        *folders, name = Path(canonical_text(image.name)).parts or ("",)
        namesakes = given.get(key(Path(name)), [])
        if folders:
            namesakes = [frame for frame in namesakes if _folders(frame)[-len(folders) :] == folders]
        if image.used and (len(namesakes) > 1 or taken.intersection(map(id, namesakes))):
            raise InputError(
                f"{saved.path}: several images are called {name}; give as many images as were registered, in the same "
                "order, with --match order"
            )
        if image.used:
            taken.update(map(id, namesakes))
        chosen.append(namesakes[0] if namesakes else None)
    return chosen


def _refuse_other_flights(saved: SavedRegistration, chosen: Chosen, frames: Sequence[Frame]) -> None:
    """Refuse equal names of another flight, or numbers that begin elsewhere, by times, or positions, or else order."""
    named = [frame for frame in chosen if frame is not None]
    measured = next(filter(None, (_by_measurement(saved, named, by) for by in (_times, _places))), None)
    others = measured or _by_shifted_number(saved, frames) or chosen
    for image, by_name, other in zip(saved.images, chosen, others, strict=True):
        if by_name is not None and other is not None and by_name is not other:
            why = "was taken at the time or place of that" if measured else "takes its place in order"
            raise InputError(
                f"{by_name.path}: has the name or number of {image.name}, but {other.path.name} {why}; "
                "say which holds: --match name, or --match order"
            )


def _by_shifted_number(saved: SavedRegistration, frames: Sequence[Frame]) -> Chosen | None:
    """Match by numbers in the names that are all higher, or lower, by the same; None where they are not."""
    registered = _varying_parts([image.name for image in saved.images])
    given = _varying_parts([without_query(frame.path).name for frame in frames])
    if registered is None or given is None or len(registered) != len(given):
        return None
    if not all(len(part) == 1 and part[0].isdecimal() for part in registered + given):
        return None
    ours, theirs = ([int(number) for (number,) in parts] for parts in (registered, given))
    frame_of, shift = dict(zip(theirs, frames, strict=True)), min(theirs) - min(ours)
    chosen = [frame_of.get(number + shift) for number in ours]
    return chosen if all(chosen) else None


def _folders(frame: Frame) -> list[str]:
    return [canonical_name(part) for part in frame.path.absolute().parent.parts]


def _by_varying_part(saved: SavedRegistration, frames: Sequence[Frame]) -> Chosen | None:
    """Match by the part that varies among the names of each side, as in V07_RED.jpg and V07_NIR.jpg."""
    registered = _varying_parts([image.name for image in saved.images])
    given = _varying_parts([without_query(frame.path).name for frame in frames])
    if registered is None or given is None or not set(registered) & set(given):
        return None
    frame_of = dict(zip(given, frames, strict=True))
    return [frame_of.get(part) for part in registered]


def _varying_parts(names: Sequence[str]) -> list[tuple[str, ...]] | None:
    """The parts of each name that are not the same in all; None if they are not unique."""
    split = [_TOKEN.findall(Path(canonical_text(name)).stem) for name in names]
    if len(names) < 2 or len({len(parts) for parts in split}) != 1:
        return None
    varying = [k for k, column in enumerate(zip(*split, strict=True)) if len(set(column)) > 1]
    keys = [tuple(parts[k] for k in varying) for parts in split]
    return keys if max(Counter(keys).values()) == 1 else None


def _times(saved: SavedRegistration, frames: Sequence[Frame]) -> FloatArray:
    """Seconds (N + M, 1) at which registered images and frames were taken; NaN where unknown."""
    of_frames = [None if frame.metadata is None else frame.metadata.timestamp for frame in frames]
    times = [*(image.timestamp for image in saved.images), *of_frames]
    return np.array([[np.nan if time is None else time] for time in times])


def _places(saved: SavedRegistration, frames: Sequence[Frame]) -> FloatArray:
    """Metres (N + M, 2) east and north where registered images and frames were taken; NaN where unknown."""
    of_images = [None if image.gps is None else GpsPosition(*image.gps) for image in saved.images]
    of_frames = [None if frame.metadata is None else frame.metadata.gps for frame in frames]
    return metres_around_median([*of_images, *of_frames])


def _by_measurement(
    saved: SavedRegistration,
    frames: Sequence[Frame],
    measure: Callable[[SavedRegistration, Sequence[Frame]], FloatArray],
) -> Chosen | None:
    """Match frames within half the distance between registered images; None if most images have no such frame."""
    if any(frame.image is not None or frame.number is not None for frame in frames):
        return None
    count, used = len(saved.images), np.array([image.used for image in saved.images])
    measured = measure(saved, frames)
    registered, given = np.where(used[:, None], measured[:count], np.nan), measured[count:]
    known, known_given = (np.flatnonzero(np.isfinite(rows).all(axis=1)) for rows in (registered, given))
    if len(known) < 2 or not len(known_given):
        return None
    reach = nearest_points(registered[known], registered[known], 2)[0][:, 1] / 2.0
    distance, index = (columns[:, 0] for columns in nearest_points(given[known_given], registered[known], 1))
    within = distance < reach
    nearest = dict(zip(known[within].tolist(), known_given[index[within]].tolist(), strict=True))
    counts = Counter(nearest.values())
    chosen = [frames[nearest[k]] if k in nearest and counts[nearest[k]] == 1 else None for k in range(count)]
    return chosen if 2 * sum(frame is not None for frame in chosen) > used.sum() else None


def _with_header(frame: Frame) -> Frame:
    """The frame with its header, if it can be read; reading the pixels reports it otherwise."""
    if frame.image is not None or frame.number is not None or frame.metadata is not None:
        return frame
    try:
        return replace(frame, header=read_metadata(frame.path))
    except InputError:
        return frame


def _by_order(saved: SavedRegistration, frames: Sequence[Frame]) -> Sequence[Frame]:
    if any(image.camera is None for image in saved.images):
        raise InputError(
            f"{saved.path}: has images that could not be read, so that the order is lost; give images of the same names"
        )
    if len(frames) != len(saved.images):
        for path in files_of(frames):
            check_readable(path)
        raise InputError(
            f"{saved.path}: has {len(saved.images)} images, but {len(frames)} others were given; give images of "
            "the same names, or equally many"
        )
    return frames


_Way = tuple[MatchedBy, Callable[[SavedRegistration, Sequence[Frame]], Chosen | None]]
_BY_NAMES: tuple[_Way, ...] = (
    ("name", partial(_by_name, key=attrgetter("name"))),
    ("name", partial(_by_name, key=attrgetter("stem"))),
    ("name", _by_varying_part),
)
_BY_HEADERS: tuple[_Way, ...] = (
    ("time", partial(_by_measurement, measure=_times)),
    ("position", partial(_by_measurement, measure=_places)),
)
