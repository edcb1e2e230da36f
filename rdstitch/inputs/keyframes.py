"""Which frames of a video are worth stitching: those that show new ground.

Neighbouring frames of a video share nearly everything. Frames are chosen so that those that follow one another share
enough to be registered, and that each frame that is passed over lies, but for a small rest, within the two chosen
around it.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rdstitch.inputs.frame_tracking import FramePlaces, tracked
from rdstitch.messages import Message

_SHARED = (0.65, 0.8, 0.9)  # of two frames in a row, in the smaller direction; more where few frames would be left
_ENOUGH = 12  # frames, from which on fewer shared matches do no harm to λ
_UNSEEN = 0.03  # share of a frame that none of the chosen ones around it need show


@dataclass(frozen=True)
class Wanted:
    """Which frames of a video are wanted."""

    every: int = 1  # every n-th one, unless they are chosen one by one
    chosen: frozenset[int] | None = None  # their numbers
    total: int = 0  # frames of the video, where they are chosen

    def __contains__(self, number: int) -> bool:
        """Whether a frame, by its number from 0, is wanted."""
        return number % self.every == 0 if self.chosen is None else number in self.chosen

    def messages(self, path: Path) -> list[Message]:
        """What the user should know of frames that were passed over for what they show."""
        if self.chosen is None or len(self.chosen) == self.total:
            return []
        used = f"{len(self.chosen)} of {self.total} frames are used, the others show the same ground"
        return [Message(f"{used}; --every 1 takes all", (str(path),), "note", code="frames-passed-over")]


def wanted_frames(every: int | None, grey: Callable[[], Iterable[NDArray[np.uint8]]]) -> Wanted:
    """Every n-th frame of a video; with None those that show new ground, by all of its grey frames."""
    if every is not None:
        return Wanted(every)
    places = tracked(grey())
    return Wanted(chosen=frozenset(keyframes(places)), total=len(places.places))


def keyframes(places: FramePlaces) -> list[int]:
    """Numbers of the frames of a video that are worth stitching, the first among them."""
    for shared in _SHARED:
        chosen = choose(places, shared)
        if len(chosen) >= _ENOUGH:
            break
    return chosen


def choose(places: FramePlaces, shared: float) -> list[int]:
    """The frames of which two in a row share so much, and that show what all of them show."""
    count = len(places.places)
    chosen = [0] if count else []
    for frame in range(1, count):
        if places.shared(chosen[-1], frame) < shared:
            # The frame before still shares enough, if it is another one.
            if frame - 1 > chosen[-1]:
                chosen.append(frame - 1)
            if places.shared(chosen[-1], frame) < shared:
                chosen.append(frame)
    rest = [*chosen, count]
    added = [number for first, end in zip(chosen, rest[1:], strict=False) for number in _unseen(places, first, end)]
    result = sorted({*chosen, *added})
    return result if len(result) > 1 or not count else sorted({0, count - 1})


def _unseen(places: FramePlaces, first: int, end: int) -> list[int]:
    """Frames between two chosen ones, or after the last, that show what neither does."""
    between = np.arange(first + 1, end)
    if not len(between):
        return []
    seen = places.seen_by(between, first)
    if end < len(places.places):
        seen |= places.seen_by(between, end)
    found: list[int] = []
    while (missing := 1.0 - seen.mean(axis=1)).max() > _UNSEEN:
        found.append(int(between[missing.argmax()]))
        seen |= places.seen_by(between, found[-1])
    return found
