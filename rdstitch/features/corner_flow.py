"""Corners of a frame, followed through the frames after it by Lucas and Kanade's method.

That costs a tenth of detection and matching, and is more exact where the expected motion is taken out of the images
first: of rendered frames that share 80 %, half of the corners are less than 0.02 pixels off, 0.12 without, and half of
SIFT's matches 0.11.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.features.prepared_image import PreparedImage

_CORNERS = 200
_QUALITY = 0.005  # of the strongest corner, that others must have
_SPACING = 0.02  # sides of the image, between corners
_TILES = 4, 3  # that corners are spread over: a vehicle's body has the strongest, and one place of a floor another
_WINDOW = 15, 15  # pixels
_LEVELS = 3  # of the pyramid, beside the image itself
_MARGIN = 8.0  # pixels, half a window
_EXPECTED_LEVELS = 1  # where the expected motion has been taken out
_NODES = 9  # a side, by which an expected motion is interpolated
_SAME_LIGHT = 0.05  # change of brightness and contrast up to which they count as constant
_STILL = 0.5  # pixels that a corner on something static in the image, such as a robot's body, moves at most
_MOVED = 3.0  # pixels that a corner on the ground moves at least
_SEEN_TO_MOVE = 15  # corners that move, where those that do not are none of the ground
_PLACES = 32  # a side, that are told apart
_SURE = 3  # still corners more than moving ones, that make a place static
_MIN_TRACKED = 0.3  # of the corners, below which they no longer stand for the keyframe


class CornerFlow:
    """Corners of the last keyframe, and where they are in the latest frame."""

    def __init__(self) -> None:
        self._last: PreparedImage | None = None
        self._from = self._at = np.empty((0, 2))
        self._votes = np.zeros((_PLACES, _PLACES), dtype=np.intp)  # of still corners over moving ones, by their places
        self.count = 0

    def begin(self, frame: PreparedImage, keyframe: FloatArray, corners: FloatArray | None = None) -> None:
        """Take the corners (N, 2) of a keyframe, and where they are in a frame; None: that is the keyframe."""
        self._last, self._from, self._at = frame, keyframe, keyframe if corners is None else corners
        self.count = len(keyframe)

    def follow(self, frame: PreparedImage) -> tuple[FloatArray, FloatArray] | None:
        """Follow the corners of the keyframe: their places before and now, (N, 2) each, pixels of ``grey``.

        None where too few of them can be followed.
        """
        last = self._last
        if last is None or last.grey.shape != frame.grey.shape or len(self._at) < max(1.0, _MIN_TRACKED * self.count):
            return None
        at, kept = _moved(last.grey, frame, self._at, _LEVELS)
        self._last, self._from, self._at = frame, self._from[kept], at[kept]
        if len(self._at) < _MIN_TRACKED * self.count:
            return None
        moved = np.linalg.norm(self._at - self._from, axis=1)
        ground = ~is_static(self._at, frame, self.static_places)
        if (moved > _MOVED).sum() >= _SEEN_TO_MOVE:
            votes = np.where(moved <= _STILL, 1, np.where(moved > _MOVED, -1, 0))
            np.add.at(self._votes, _places(self._at, frame), votes)
            self._votes = np.clip(self._votes, -_SURE, _SURE)
            ground &= moved > _STILL
        return self._from[ground], self._at[ground]

    @property
    def static_places(self) -> BoolArray:
        """Cells (P, P) of the image in which corners stayed while others moved: a bumper, a mast, dirt."""
        return np.asarray(self._votes >= _SURE)


def is_static(points: FloatArray, frame: PreparedImage, static_places: BoolArray) -> BoolArray:
    """Which points (N, 2) of a frame lie in static places, see :attr:`CornerFlow.static_places`."""
    return np.asarray(static_places[_places(points, frame)])


def _places(points: FloatArray, frame: PreparedImage) -> tuple[IntArray, IntArray]:
    x, y = np.clip(points * _PLACES / frame.grey.shape[::-1], 0, _PLACES - 1).astype(np.intp).T
    return y, x


def corners_of(frame: PreparedImage) -> FloatArray:
    """Detect corners (N, 2) clear of the mask, pixels of ``grey``, as many in each part of the image."""
    height, width = frame.grey.shape
    across, down = (
        np.linspace(0, side, count + 1).astype(int) for side, count in zip((width, height), _TILES, strict=True)
    )
    most, spacing = _CORNERS // (_TILES[0] * _TILES[1]), _SPACING * max(frame.grey.shape)
    tiles: list[FloatArray] = [np.empty((0, 2))]
    for top, bottom in pairwise(down.tolist()):
        for left, right in pairwise(across.tolist()):
            corners = cv2.goodFeaturesToTrack(frame.grey[top:bottom, left:right], most, _QUALITY, spacing)
            if corners is not None:
                tiles.append(corners[:, 0].astype(np.float64) + np.array([left, top]))
    spread = np.concatenate(tiles)
    return spread[_usable(frame, spread)]


def matched_corners(
    other: PreparedImage, frame: PreparedImage, corners: FloatArray, to_other: Callable[[FloatArray], FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Match corners (N, 2) of a frame with another image, where it is expected to show them: (M, 2) each, in both.

    The other image is warped as ``to_other`` expects, which maps pixels (N, 2) of the frame to its pixels: what is left
    is a small shift.
    """
    (x, across), (y, down) = (_interpolation(side) for side in frame.grey.shape[::-1])
    places = to_other(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)).reshape(_NODES, _NODES, 2)
    before = to_other(corners)
    seen = _usable(other, before, _MARGIN)
    if not np.isfinite(places).all() or not seen.any():
        return np.empty((0, 2)), np.empty((0, 2))
    places = np.einsum("yb,bac,xa->yxc", down, places, across, optimize=True).astype(np.float32)
    warped = cv2.remap(other.grey, places, None, cv2.INTER_CUBIC)  # type: ignore[call-overload]
    at, kept = _moved(warped, frame, corners[seen], _EXPECTED_LEVELS)
    return before[seen][kept], at[kept]


def _moved(
    before: NDArray[np.uint8], after: PreparedImage, corners: FloatArray, levels: int
) -> tuple[FloatArray, BoolArray]:
    """Track corners (N, 2) of one frame into another; where they are, and which were found there (N,)."""
    start = corners[:, None].astype(np.float32)
    # The method takes brightness for constant; exposure and lamps do not.
    shown = (before > 0).astype(np.uint8)  # not what was warped from beyond the image
    (mean, spread), (mean_after, spread_after) = (
        np.ravel(cv2.meanStdDev(grey, mask=shown)) for grey in (before, after.grey)
    )
    gain = spread_after / max(spread, 1e-6)
    if abs(math.log(max(gain, 1e-6))) > _SAME_LIGHT or abs(mean_after - mean) > _SAME_LIGHT * mean:
        same = np.rint(before * np.float32(gain) + np.float32(mean_after - gain * mean))
        before = np.clip(same, 0, 255).astype(np.uint8)
    at, status, _ = cv2.calcOpticalFlowPyrLK(
        before, after.grey, start, np.empty_like(start), winSize=_WINDOW, maxLevel=levels
    )
    moved = np.asarray(at[:, 0], dtype=np.float64)
    return moved, np.asarray(status[:, 0] > 0) & _usable(after, moved)


def _usable(frame: PreparedImage, points: FloatArray, margin: float = 0.0) -> BoolArray:
    """Select the points (N, 2) that lie in the frame, so far from its border, and clear of its mask."""
    last = np.array(frame.grey.shape[::-1]) - 1.0
    inside = (points >= margin).all(axis=1) & (points <= last - margin).all(axis=1)
    return np.asarray(inside & frame.covers(np.nan_to_num(points), np.full(len(points), _MARGIN)))


@lru_cache(maxsize=8)
def _interpolation(side: int) -> tuple[FloatArray, FloatArray]:
    """Chebyshev's nodes (K,) along a side, pixels, and the matrix (side, K) that interpolates between them."""
    angle = (np.arange(_NODES) + 0.5) * np.pi / _NODES
    pixel = (2.0 * np.arange(side) + 1.0) / side - 1.0
    # Barycentric weights; no pixel lies on a node but by chance, and then next to it.
    weight = (-1.0) ** np.arange(_NODES) * np.sin(angle) / (pixel[:, None] - np.cos(angle) + 1e-12)
    return (np.cos(angle) + 1.0) * side / 2.0 - 0.5, weight / weight.sum(axis=1, keepdims=True)
