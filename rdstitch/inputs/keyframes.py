"""Keyframes of a video: the frames that show new ground, and are worth stitching.

Neighbouring frames of a video share nearly everything. Frames are chosen so that those that follow one another share
enough to be registered, and that each frame that is passed over lies, but for a small rest, within the two chosen
around it. What two frames share is known by corners, which are followed on small versions by Lucas and Kanade's method,
and an affine motion that is fitted to them.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray, UInt8Array
from rdstitch.features.corner_flow import CornerFlow, corners_of
from rdstitch.features.prepared_image import PreparedImage
from rdstitch.results.messages import Message

# All unmeasured but for tests of rendered videos.
_SHARED = (0.65, 0.8, 0.9)  # fractions of two frames in a row, the smaller one; more where few frames would be left
_ENOUGH = 12  # frames, from which on fewer shared matches do no harm to λ
_UNSEEN = 0.03  # fraction of a frame that none of the chosen ones around it need show
_SIDE = 320  # pixels of the longer side that frames are tracked at
_MIN_CORNERS = 12  # corners that a motion is believed by
_AGREEING = 0.4  # fraction of the corners that must agree
_ERROR = 0.02  # of a motion, in sides: lenses and tilts are not affine
_RENEWED_FROM = 0.5  # fraction of the corners, or of the side that they have come, after which new ones are taken
_GRID = 16  # points a side by which areas are measured


@dataclass(frozen=True, eq=False)
class FramePlaces:
    """Places of the frames of a video."""

    size: FloatArray  # (2,): of a frame, pixels of its small version
    places: FloatArray  # (N, 3, 3): from each frame to what all frames of its track have in common; affine
    track: IntArray  # (N,), intp: number of the track; one ends where a frame cannot be found again in the next

    def seen_by(self, frames: IntArray, other: int) -> BoolArray:
        """Mark the points of a grid in some frames that another frame shows, (M, P)."""
        axis = (np.arange(_GRID) + 0.5) / _GRID
        points = np.stack([*np.meshgrid(*(axis * side for side in self.size)), np.ones((_GRID, _GRID))]).reshape(3, -1)
        in_other = (np.linalg.inv(self.places[other]) @ self.places[frames] @ points)[:, :2]
        inside = ((in_other >= 0.0) & (in_other <= self.size[:, None])).all(axis=1)
        return np.asarray(inside & (self.track[frames] == self.track[other])[:, None])

    def shared(self, first: int, second: int) -> float:
        """Fraction of each of two frames that the other shows, whichever is smaller."""
        pair = np.array([first, second])
        return float(min(self.seen_by(pair[1:], first).mean(), self.seen_by(pair[:1], second).mean()))


def tracked(frames: Iterable[UInt8Array]) -> FramePlaces:
    """Follow the frames of a video, grey (H, W), from the first to the last."""
    places: list[FloatArray] = []
    track: list[int] = []
    size, flow, begun_at = (1, 1), CornerFlow(), np.eye(3)
    for frame in frames:
        small, factor = frame, _SIDE / max(frame.shape)
        if factor < 1.0:
            small = np.asarray(cv2.resize(frame, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), np.uint8)
        size = small.shape[1], small.shape[0]
        image = PreparedImage(small, None, np.ones(2), size)
        matched = flow.follow(image)
        motion, worn = (None, True) if matched is None else _motion(*matched, max(size), flow.count)
        track.append((track[-1] + (motion is None)) if track else 0)
        places.append(np.eye(3) if motion is None else begun_at @ motion)
        if worn:
            flow.begin(image, corners_of(image))
            begun_at = places[-1]
    return FramePlaces(np.array(size, dtype=np.float64), np.array(places).reshape(-1, 3, 3), np.array(track, np.intp))


def _motion(before: FloatArray, now: FloatArray, side: int, count: int) -> tuple[FloatArray | None, bool]:
    """The motion (3, 3) of points back to where they were, None where it is not known; and whether to begin anew."""
    motion, agree = fitted_affine(before, now, _ERROR * side)
    if motion is None or agree.sum() < max(_MIN_CORNERS, _AGREEING * len(agree)) or np.linalg.det(motion[:, :2]) <= 0.0:
        return None, True
    way = float(np.median(np.linalg.norm(now - before, axis=1)))
    return np.vstack([motion, [0.0, 0.0, 1.0]]), len(now) < _RENEWED_FROM * count or way > _RENEWED_FROM * side / 2


def fitted_affine(target: FloatArray, source: FloatArray, threshold: float) -> tuple[FloatArray | None, BoolArray]:
    """Fit the affine motion (2, 3) that brings most points (N, 2) to others, and mark those (N,)."""
    known = np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1)
    inliers = np.zeros(len(source), dtype=np.bool_)
    if known.sum() < 3:
        return None, inliers
    estimate: Any = cv2.estimateAffine2D(
        source[known], target[known], method=cv2.RANSAC, ransacReprojThreshold=threshold
    )
    motion, agree = estimate
    if motion is None:
        return None, inliers
    inliers[known] = agree[:, 0] > 0
    return np.asarray(motion, dtype=np.float64), inliers


@dataclass(frozen=True)
class FrameSelection:
    """The frames of a video that are wanted."""

    every: int = 1  # every n-th one, unless they are chosen one by one
    chosen: frozenset[int] | None = None  # their numbers
    total: int = 0  # frames of the video, where they are chosen

    def __contains__(self, number: int) -> bool:
        """Whether a frame, by its number from 0, is wanted."""
        return number % self.every == 0 if self.chosen is None else number in self.chosen

    def messages(self, path: Path) -> list[Message]:
        """Messages on frames that were passed over for what they show."""
        if self.chosen is None or len(self.chosen) == self.total:
            return []
        used = f"{len(self.chosen)} of {self.total} frames are used, the others show the same ground"
        return [Message(f"{used}; --every 1 takes all", (str(path),), "note", code="frames-passed-over")]


def wanted_frames(every: int | None, grey: Callable[[], Iterable[UInt8Array | None]]) -> FrameSelection:
    """Every n-th frame of a video; with None those that show new ground, by all of its grey frames that are decoded."""
    if every is not None:
        return FrameSelection(every)
    decoded: list[int] = []

    def frames() -> Iterator[UInt8Array]:
        for number, frame in enumerate(grey()):
            if frame is not None:
                decoded.append(number)
                yield frame

    chosen = keyframes(tracked(frames()))
    return FrameSelection(chosen=frozenset(decoded[k] for k in chosen), total=len(decoded))


def keyframes(places: FramePlaces) -> list[int]:
    """Numbers of the frames of a video that are worth stitching, the first among them.

    By the least of :data:`_SHARED` that leaves enough of them; by the largest where none does.
    """
    for shared in _SHARED:
        chosen = select_keyframes(places, shared)
        if len(chosen) >= _ENOUGH:
            break
    return chosen


def select_keyframes(places: FramePlaces, shared: float) -> list[int]:
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
    chosen: list[int] = []
    while (missing := 1.0 - seen.mean(axis=1)).max() > _UNSEEN:
        chosen.append(int(between[missing.argmax()]))
        seen |= places.seen_by(between, chosen[-1])
    return chosen
