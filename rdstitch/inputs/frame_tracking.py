"""Where the frames of a video lie, from one to the next: what they share.

Corners are followed on small versions by Lucas and Kanade's method, and an affine motion is fitted to them, which is
good enough to say how much two frames share.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.features.prepared_image import PreparedImage
from rdstitch.inputs.corner_flow import CornerFlow, corners_of, fitted_affine

_SIDE = 320  # pixels of the longer side that frames are tracked at
_MIN_CORNERS = 12  # corners that a motion is believed by
_AGREEING = 0.4  # share of the corners that must agree
_ERROR = 0.02  # of a motion, in sides: lenses and tilts are not affine
_WORN = 0.5  # share of the corners, or of the side that they have come, after which new ones are taken
_GRID = 16  # points a side by which areas are measured


@dataclass(frozen=True)
class FramePlaces:
    """Where the frames of a video lie."""

    size: FloatArray  # (2,): of a frame, pixels of its small version
    places: FloatArray  # (N, 3, 3): from each frame to what all frames of its track have in common; affine
    track: NDArray[np.intp]  # (N,), intp: number of the track; one ends where a frame cannot be found again in the next

    def seen_by(self, frames: NDArray[np.intp], other: int) -> BoolArray:
        """Which points of a grid in some frames another frame shows, (M, P)."""
        axis = (np.arange(_GRID) + 0.5) / _GRID
        points = np.stack([*np.meshgrid(*(axis * side for side in self.size)), np.ones((_GRID, _GRID))]).reshape(3, -1)
        there = (np.linalg.inv(self.places[other]) @ self.places[frames] @ points)[:, :2]
        inside = ((there >= 0.0) & (there <= self.size[:, None])).all(axis=1)
        return np.asarray(inside & (self.track[frames] == self.track[other])[:, None])

    def shared(self, first: int, second: int) -> float:
        """Share of each of two frames that the other shows, whichever is smaller."""
        pair = np.array([first, second])
        return float(min(self.seen_by(pair[1:], first).mean(), self.seen_by(pair[:1], second).mean()))


def tracked(frames: Iterable[NDArray[np.uint8]]) -> FramePlaces:
    """Follow the frames of a video, grey (H, W), from the first to the last."""
    places: list[FloatArray] = []
    track: list[int] = []
    size, flow, begun_at = (1, 1), CornerFlow(), np.eye(3)
    for frame in frames:
        small = _small(frame)
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
    return np.vstack([motion, [0.0, 0.0, 1.0]]), len(now) < _WORN * count or way > _WORN * side / 2


def _small(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A frame no longer than ``_SIDE``."""
    factor = _SIDE / max(frame.shape)
    if factor >= 1.0:
        return frame
    return np.asarray(cv2.resize(frame, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), dtype=np.uint8)
