"""The matches of many pairs of images, as robust estimation sees them: one array with the pairs first."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import BoolArray, FloatArray, IntArray, Rows, as_numbers
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera

_STEPS_PER_OCTAVE = 4
_MIN_WIDTH = 16
_FARTHEST = 1e9  # pixels: squares of squares of them are still numbers


@dataclass(frozen=True, eq=False)
class Measurements(Rows):
    """Matches of B pairs of images, normalized by half the diagonal of their image, padded to N a pair."""

    x1: FloatArray  # x1, x2: (B, 2, N): measured points; zeros where ``present`` is False
    x2: FloatArray
    present: BoolArray  # (B, N) bool: which are matches; the rest is padding, or matches that are left out
    count: IntArray  # (B,): matches of each pair: they come before the padding
    px: FloatArray  # (B,): pixels of image 2 in one normalized unit
    # (B,): pixels of image 2 that one pixel of image 1 becomes when normalized coordinates are kept
    px_ratio: FloatArray

    @classmethod
    def of_pairs(
        cls, points: Sequence[tuple[FloatArray, FloatArray]], cameras: Sequence[tuple[Camera, Camera]]
    ) -> Self:
        """Normalize checked matches, pixels (N, 2), by the cameras of both images of each pair."""
        counts = np.array([len(points1) for points1, _ in points], dtype=np.intp)
        width = padded_length(int(counts.max(initial=0)))
        x = np.zeros((2, len(points), 2, width))
        for row, (both, pair_cameras) in enumerate(zip(points, cameras, strict=True)):
            for side, (measured, camera) in enumerate(zip(both, pair_cameras, strict=True)):
                x[side, row, :, : counts[row]] = camera.normalize(measured).T
        size1, size2 = (np.array([pair[side].scale for pair in cameras]) for side in (0, 1))
        return cls(x[0], x[1], np.arange(width) < counts[:, None], counts, size2, size2 / size1)

    @classmethod
    def from_pixels(cls, points1: ArrayLike, points2: ArrayLike, camera1: Camera, camera2: Camera) -> Self:
        """Check and normalize the matches of one pair, pixels (N, 2)."""
        return cls.of_pairs([checked_matches(points1, points2)], [(camera1, camera2)])

    @cached_property
    def radius2(self) -> FloatArray:
        """Squared distance of the points of image 1 from the distortion centre, (B, N)."""
        return self.x1[:, 0] ** 2 + self.x1[:, 1] ** 2

    def only(self, chosen: BoolArray) -> Self:
        """The measurements without the matches that are not chosen (B, N)."""
        return type(self)(self.x1, self.x2, self.present & chosen, self.count, self.px, self.px_ratio)

    def at(self, index: IntArray) -> Self:
        """The matches at some places of each pair, (B, K); the padding at those beyond the matches."""
        within = np.minimum(index, self.present.shape[1] - 1)
        x1, x2 = (np.take_along_axis(x, within[:, None], axis=2) for x in (self.x1, self.x2))
        present = np.take_along_axis(self.present, within, axis=1) & (index < self.count[:, None])
        return type(self)(x1, x2, present, present.sum(axis=1), self.px, self.px_ratio)


def padded_length(count: int) -> int:
    """Matches that ``count`` are padded to: four steps an octave, so that pairs of similar size share a batch.

    It depends on the pair alone, and so does every sum over its matches: whatever the pairs beside it.
    """
    if count <= _MIN_WIDTH:
        return _MIN_WIDTH
    step = 1 << ((count - 1).bit_length() - _STEPS_PER_OCTAVE.bit_length())
    return -(-count // step) * step


def checked_matches(points1: ArrayLike, points2: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Matches as two arrays (N, 2) of float64; ArgumentError where shapes differ or a value is not finite."""
    p1, p2 = as_numbers("points1", points1), as_numbers("points2", points2)
    for name, points in (("points1", p1), ("points2", p2)):
        if points.ndim != 2 or points.shape[1] != 2:
            raise ArgumentError(f"{name} must have shape (N, 2), not {points.shape}")
        if not np.isfinite(points).all():
            raise ArgumentError(f"{name} has values that are not finite")
        if not (np.abs(points) < _FARTHEST).all():
            raise ArgumentError(f"{name} has values that are no pixels: {np.abs(points).max():.3g}")
    if len(p1) != len(p2):
        raise ArgumentError(f"points1 and points2 differ in length: {len(p1)} and {len(p2)}")
    return p1, p2
