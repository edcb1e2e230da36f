"""Lines that cross a seam: whether what one image shows of them goes on in the other.

A person follows a line (a kerb, a roof, the arm of a crane) and sees where it ends or steps; where only leaves,
branches, pebbles or shadows differ on both sides of a seam, nothing is seen to break. Lines are found by the line
segment detector of Grompone von Gioi et al. (2010); the profile across a line is averaged along it, so that texture
counts little.
"""

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from rdstitch.arrays import AnyArray, FloatArray, Int32Array, IntArray
from rdstitch.compositing.boxes import Box

# Pixels of images with a diagonal of 1000:
_NEAR = 8  # from a place within which a line counts there, as far as places are apart
_ACROSS = 6  # of the profile on either side of a line
_MIN_SIDE = 4  # of a line on either side of a seam that are compared
_OFF = 2  # by which a line may be off beyond a seam before it is seen to step
_CONTINUED = 0.4  # of its contrast that a line keeps beyond a seam


class _Image:
    """An image on the canvas; its lines are found when they are needed."""

    def __init__(self, box: Box, grey: AnyArray, full: float, min_length: float) -> None:
        self.box, self.grey, self._full, self._min_length = box, grey, full, min_length

    @cached_property
    def lines(self) -> FloatArray:
        """Ends (N, 2, 2) of the long lines on the canvas."""
        levels = self.grey.astype(np.float32)
        levels = (levels - levels.min()) * np.float32(255.0 / self._full)
        segments: Any = cv2.createLineSegmentDetector().detect(np.clip(levels, 0, 255).astype(np.uint8))[0]
        ends = np.reshape(np.empty(0) if segments is None else segments, (-1, 2, 2)).astype(np.float64)
        long = np.hypot(*(ends[:, 1] - ends[:, 0]).T) >= self._min_length
        return np.asarray(ends[long] + self.box[:2])

    def near(self, at: FloatArray, reach: int) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Pixels (N, 2) of each line that passes by a place, no farther than ``reach`` from it, and its normal."""
        start, way = self.lines[:, 0], self.lines[:, 1] - self.lines[:, 0]
        length = np.hypot(*way.T)
        along = way / length[:, None]
        normal = np.column_stack([-along[:, 1], along[:, 0]])
        nearest, away = (np.einsum("ni,ni->n", at - start, axis) for axis in (along, normal))
        first, last = np.maximum(nearest - reach, 0.0), np.minimum(nearest + reach, length)
        for k in np.flatnonzero((np.abs(away) <= _NEAR) & (last > first)):
            yield start[k] + np.arange(first[k], last[k])[:, None] * along[k], normal[k]

    def edges(self, points: FloatArray, normal: FloatArray) -> FloatArray:
        """How the image changes from pixel to pixel across a line, the mean along it."""
        offsets = np.arange(-_ACROSS, _ACROSS + 1)[:, None, None] * normal
        x, y = np.moveaxis(points + offsets - self.box[:2], -1, 0).astype(np.float32)
        left, top = max(int(x.min()), 0), max(int(y.min()), 0)
        part = self.grey[top : int(y.max()) + 2, left : int(x.max()) + 2].astype(np.float32)
        levels = cv2.remap(part, x - left, y - top, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.diff(levels.mean(axis=1, dtype=np.float64))


class SeamLines:
    """The lines of all images that own parts of a canvas; a line is followed for ``reach`` pixels from a place.

    ``labels`` (h, w) are the owners of the pixels of a reduced canvas, each ``label_size`` pixels long.
    """

    def __init__(self, labels: Int32Array, label_size: float, reach: int) -> None:
        self._labels, self._label_size, self._reach = labels, label_size, reach
        self._images: dict[int, _Image] = {}

    def add(self, owner: int, box: Box, grey: AnyArray, full: float, min_length: float) -> None:
        """An image (h, w) on a box of the canvas, ``full`` grey levels from black to white, with its lines."""
        self._images[owner] = _Image(box, grey, full, min_length)

    def end(self, pair: IntArray, at: FloatArray) -> bool:
        """Whether a line of one image of a pair that crosses their seam near a place is not there in the other."""
        return any(self._ends(one, other, at) for one, other in (pair, pair[::-1]))

    def _ends(self, one: int, other: int, at: FloatArray) -> bool:
        for points, normal in self._images[one].near(at, self._reach):
            owners = self._owners(points)
            beyond = points[owners == other]
            if len(beyond) < _MIN_SIDE or (owners == one).sum() < _MIN_SIDE:
                continue
            here, there = (self._images[k].edges(beyond, normal) for k in (one, other))
            middle = slice(_ACROSS - _OFF, _ACROSS + _OFF)
            edge = middle.start + int(np.argmax(np.abs(here[middle])))
            continued = float((np.sign(here[edge]) * there[edge - _OFF : edge + _OFF + 1]).max())
            if continued < _CONTINUED * abs(here[edge]):
                return True
        return False

    def _owners(self, points: FloatArray) -> Int32Array:
        rows, columns = self._labels.shape
        x, y = ((points + 0.5) / self._label_size).astype(np.intp).T
        return np.asarray(self._labels[np.clip(y, 0, rows - 1), np.clip(x, 0, columns - 1)])
