"""Corners of a frame, followed through the frames after it by Lucas and Kanade's method.

Between keyframes that takes the place of detection and matching, which cost ten times as much.
"""

from typing import Any

import cv2
import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.features.prepared_image import PreparedImage

_CORNERS, _QUALITY, _SPACING = 200, 0.005, 0.02  # the spacing is in sides of the image
_WINDOW, _LEVELS = (15, 15), 3
_MASK_MARGIN = 8.0  # pixels, half a window
_STILL, _MOVED = 0.5, 3.0  # pixels: what stays in the image, such as a robot's body, and what moves with the ground
_SEEN_TO_MOVE = 15  # corners that move, where those that do not are none of the ground
_MIN_SHARE = 0.3  # of the corners, below which they no longer stand for the keyframe


class CornerFlow:
    """Corners of the last keyframe, and where they are in the latest frame."""

    def __init__(self) -> None:
        self._last: PreparedImage | None = None
        self._from = self._at = np.empty((0, 1, 2), dtype=np.float32)
        self.count = 0

    def begin(self, keyframe: PreparedImage | None) -> None:
        """Take the corners of a keyframe; None: there are none to be followed."""
        self._last, self.count = keyframe, 0
        if keyframe is None:
            return
        detected = cv2.goodFeaturesToTrack(keyframe.grey, _CORNERS, _QUALITY, _SPACING * max(keyframe.grey.shape))
        corners = np.empty((0, 1, 2), dtype=np.float32) if detected is None else detected
        self._from = self._at = corners[_usable(keyframe, corners)]
        self.count = len(self._from)

    def follow(self, frame: PreparedImage) -> tuple[FloatArray, FloatArray] | None:
        """Follow the corners of the keyframe: their places before and now, (N, 2) each, pixels of ``grey``.

        None where too few of them can be followed.
        """
        last = self._last
        if last is None or last.grey.shape != frame.grey.shape or len(self._at) < max(1.0, _MIN_SHARE * self.count):
            return None
        at, kept = _moved(last, frame, self._at)
        kept &= _usable(frame, at)
        self._last, self._from, self._at = frame, self._from[kept], at[kept]
        if len(self._at) < _MIN_SHARE * self.count:
            return None
        before, now = self._from[:, 0].astype(np.float64), self._at[:, 0].astype(np.float64)
        moved = np.linalg.norm(now - before, axis=1)
        ground = moved > (_STILL if (moved > _MOVED).sum() >= _SEEN_TO_MOVE else -1.0)
        return before[ground], now[ground]


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


def _moved(before: PreparedImage, after: PreparedImage, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Track corners (N, 1, 2) of one frame into another; where they are, and which were found (N,)."""
    at, status, _ = cv2.calcOpticalFlowPyrLK(
        before.grey, after.grey, corners, np.empty_like(corners), winSize=_WINDOW, maxLevel=_LEVELS
    )
    return np.asarray(at), np.asarray(status[:, 0] > 0)


def _usable(frame: PreparedImage, corners: np.ndarray) -> np.ndarray:
    """Select the corners (N, 1, 2) that lie in the frame and clear of its mask."""
    points = corners[:, 0].astype(np.float64)
    inside = (points >= 0.0).all(axis=1) & (points <= np.array(frame.grey.shape[::-1]) - 1.0).all(axis=1)
    return np.asarray(inside & frame.covers(points, np.full(len(points), _MASK_MARGIN)))
