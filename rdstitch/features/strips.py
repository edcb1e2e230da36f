"""SIFT of a large picture in strips, in a third of the memory: its finest octave has four times the picture's pixels.

The two finest octaves, most of the memory and most of the keypoints, are found in overlapping strips, where they are
what they would be in the whole; the coarser ones are those of the picture at half its size.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features.keypoints import Features
from rdstitch.features.opencv import Grey, OpenCVDetection
from rdstitch.features.options import FeatureOptions

LARGE = 1_500_000
"""Px from which on a picture is taken in strips."""

_STRIP = 400_000  # pixels of a strip without its overlap, about
# How far the descriptors of the two finest octaves reach, pixels: sigma of 4, times 3 a cell, 2.5 cells, diagonally,
# and what is smoothed there.
_OVERLAP = 64
_FINEST = (255, 0)  # octaves -1 and 0, as OpenCV packs them


@dataclass(frozen=True, eq=False)
class _Part:
    """Keypoints of a strip that begins ``top`` pixels down, or of a picture that is smaller by ``factor``."""

    detection: OpenCVDetection
    top: int
    factor: int

    @property
    def points(self) -> FloatArray:
        """Places in the whole picture, pixels."""
        return self._in_whole(self.detection.points)

    def describe(self, chosen: NDArray[np.intp]) -> Features:
        """Features in pixels of the whole picture."""
        found = self.detection.describe(chosen)
        return replace(
            found,
            points=self._in_whole(found.points),
            scale=found.scale * self.factor,
            response=found.response * self.factor,
        )

    def _in_whole(self, points: FloatArray) -> FloatArray:
        return (points + 0.5) * self.factor - 0.5 + (0.0, self.top)


@dataclass(frozen=True, eq=False)
class StripsDetection:
    """Keypoints of a picture, found in parts of it."""

    parts: tuple[_Part, ...]

    @classmethod
    def find(cls, grey: Grey, options: FeatureOptions) -> Self:
        """Find the keypoints of a picture by SIFT."""
        size = (grey.shape[1] // 2, grey.shape[0] // 2)
        half = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        coarse = OpenCVDetection.find(half, options)
        # The finest octave of the small picture is the second of the large one, but less exact.
        coarse = coarse.take(np.flatnonzero(~_in_octaves(coarse, _FINEST[:1])))
        return cls((*_strips(grey, options), _Part(coarse, 0, 2)))

    @property
    def points(self) -> FloatArray:
        """Places, pixels of the picture, (N, 2)."""
        return np.concatenate([part.points for part in self.parts])

    @property
    def scale(self) -> FloatArray:
        """Diameters, pixels, (N,)."""
        return np.concatenate([part.factor * part.detection.scale for part in self.parts])

    @property
    def response(self) -> FloatArray:
        """Strengths, (N,): contrast times diameter, as of a picture that is taken whole."""
        return np.concatenate([part.factor * part.detection.response for part in self.parts])

    def describe(self, chosen: NDArray[np.intp]) -> Features:
        """Describe the chosen keypoints, part by part."""
        stops = np.cumsum([len(part.detection.points) for part in self.parts])
        found = []
        for part, stop in zip(self.parts, stops, strict=True):
            start = stop - len(part.detection.points)
            found.append(part.describe(chosen[(chosen >= start) & (chosen < stop)] - start))
        return Features.concatenate(found)


def _strips(grey: Grey, options: FeatureOptions) -> Iterator[_Part]:
    """The finest octave, strip by strip."""
    height = len(grey)
    borders = np.linspace(0, height, -(-grey.size // _STRIP) + 1).astype(int)
    for start, stop in zip(borders[:-1].tolist(), borders[1:].tolist(), strict=True):
        top = max(0, start - _OVERLAP)
        found = OpenCVDetection.find(grey[top : min(height, stop + _OVERLAP)], options)
        row = found.points[:, 1] + top
        # Of what two strips see either keeps its own half.
        own = ((row >= start) | (start == 0)) & ((row < stop) | (stop == height))
        yield _Part(found.take(np.flatnonzero(own & _in_octaves(found, _FINEST))), top, 1)


def _in_octaves(found: OpenCVDetection, octaves: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which keypoints are of one of the octaves."""
    return np.array([keypoint.octave & 255 in octaves for keypoint in found.keypoints], dtype=np.bool_)
