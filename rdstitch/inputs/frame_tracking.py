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

_SIDE = 320  # pixels of the longer side that frames are tracked at
_CORNERS, _QUALITY, _APART = 120, 0.01, 8.0
_WINDOW = (15, 15)  # pixels, in which a corner is found again
_MIN_CORNERS = 12  # corners that a motion is believed by
_AGREEING = 0.4  # share of the corners that must agree
_ERROR = 0.02  # of a motion, in sides: lenses and tilts are not affine
_STILL, _MOVED = 0.5, 3.0  # pixels: what stays in the image, such as a robot's body, and what moves with the ground
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
    size = np.ones(2)
    corners: _Corners | None = None
    for frame in frames:
        small = _small(frame)
        size = np.array(small.shape[::-1], dtype=np.float64)
        motion = None if corners is None else corners.follow(small)
        if corners is None or motion is None:
            track.append(track[-1] + 1 if track else 0)
            places.append(np.eye(3))
        else:
            track.append(track[-1])
            places.append(corners.place @ np.linalg.inv(motion))
        if corners is None or motion is None or corners.worn:
            corners = _Corners(small, places[-1])
    return FramePlaces(size, np.array(places).reshape(-1, 3, 3), np.array(track, dtype=np.intp))


class _Corners:
    """Corners of one frame, followed through the next ones."""

    def __init__(self, image: NDArray[np.uint8], place: FloatArray) -> None:
        found = cv2.goodFeaturesToTrack(image, _CORNERS, _QUALITY, _APART)
        self._from = np.empty((0, 1, 2), dtype=np.float32) if found is None else found
        self._at, self._last, self._count = self._from, image, len(self._from)
        self.place = place
        self.worn = False

    def follow(self, image: NDArray[np.uint8]) -> FloatArray | None:
        """The motion (3, 3) from the frame of the corners to the next one; None where it is not known."""
        if image.shape != self._last.shape or len(self._at) < _MIN_CORNERS:
            return None
        at, status, _ = cv2.calcOpticalFlowPyrLK(self._last, image, self._at, np.empty_like(self._at), winSize=_WINDOW)
        self._last = image
        inside = (at >= 0.0).all(axis=(1, 2)) & (at[:, 0] < image.shape[::-1]).all(axis=1)
        kept = (status[:, 0] > 0) & inside
        self._from, self._at = self._from[kept], at[kept]
        way = np.linalg.norm(self._at - self._from, axis=2)[:, 0]
        ground = np.ones(len(way), dtype=np.bool_)
        if (way > _MOVED).sum() >= _MIN_CORNERS:
            ground = way > _STILL
        if ground.sum() < _MIN_CORNERS:
            return None
        side = max(image.shape)
        motion, agree = cv2.estimateAffine2D(
            self._from[ground], self._at[ground], method=cv2.RANSAC, ransacReprojThreshold=_ERROR * side
        )
        if (
            motion is None
            or agree.sum() < max(_MIN_CORNERS, _AGREEING * len(agree))
            or np.linalg.det(motion[:, :2]) <= 0.0
        ):
            return None
        self.worn = bool(len(self._at) < _WORN * self._count or np.median(way) > _WORN * side / 2)
        return np.vstack([motion, [0.0, 0.0, 1.0]])


def _small(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A frame no longer than ``_SIDE``."""
    factor = _SIDE / max(frame.shape)
    if factor >= 1.0:
        return frame
    return np.asarray(cv2.resize(frame, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), dtype=np.uint8)
