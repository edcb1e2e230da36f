"""SIFT of large images in tiles, so that memory does not grow with the image.

SIFT's finest octave has four times the pixels of an image. Of a large one the two finest octaves, most of the memory
and most of the keypoints, are found in overlapping tiles, where they are what they would be in the whole; the coarser
ones are those of the image at half its size, and so on.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features.keypoints import Features
from rdstitch.features.opencv import Grey, OpenCVDetection
from rdstitch.options.feature_options import FeatureOptions

LARGE = 1_250_000
"""Pixels from which on an image is taken in tiles: a whole one takes 230 bytes a pixel."""

_SIDE = 640  # pixels of a tile without its overlap, at most
# How far the descriptors of the two finest octaves reach, pixels: sigma of 4, times 3 a cell, 2.5 cells, diagonally,
# and what is smoothed there.
_OVERLAP = 64
_UPSAMPLED, _FIRST = 255, 0  # octaves -1 and 0, as OpenCV packs them


@dataclass(frozen=True, eq=False)
class _Part:
    """Keypoints of a tile."""

    detection: OpenCVDetection
    corner: NDArray[np.intp]  # (2,): of the tile, pixels of the reduced image that it is cut from
    factor: FloatArray  # (2,): pixels of the image itself for one of the reduced one, horizontally and vertically

    @property
    def points(self) -> FloatArray:
        """Places in the whole image, pixels."""
        return self._in_whole(self.detection.points)

    @property
    def enlargement(self) -> float:
        """Pixels of the image itself for one of the reduced one, in the mean of both directions."""
        return float(np.sqrt(self.factor.prod()))

    def describe(self, chosen: NDArray[np.intp]) -> Features:
        """Features in pixels of the whole image."""
        features = self.detection.describe(chosen)
        return replace(
            features,
            points=self._in_whole(features.points),
            scale=features.scale * self.enlargement,
            response=features.response * self.enlargement,
        )

    def _in_whole(self, points: FloatArray) -> FloatArray:
        return (points + self.corner + 0.5) * self.factor - 0.5


@dataclass(frozen=True, eq=False)
class SiftTilesDetection:
    """Keypoints of an image, found in parts of it."""

    parts: tuple[_Part, ...]

    @classmethod
    def find(cls, grey: Grey, options: FeatureOptions) -> Self:
        """Find the keypoints of an image by SIFT."""
        return cls(tuple(_parts(grey, options)))

    @property
    def points(self) -> FloatArray:
        """Places, pixels of the image, (N, 2)."""
        return np.concatenate([part.points for part in self.parts])

    @property
    def scale(self) -> FloatArray:
        """Diameters, pixels, (N,)."""
        return np.concatenate([part.enlargement * part.detection.scale for part in self.parts])

    @property
    def response(self) -> FloatArray:
        """Strengths, (N,): contrast times diameter, as of an image that is taken whole."""
        return np.concatenate([part.enlargement * part.detection.response for part in self.parts])

    def describe(self, chosen: NDArray[np.intp]) -> Features:
        """Describe the chosen keypoints, part by part."""
        stops = np.cumsum([len(part.detection.points) for part in self.parts])
        features = []
        for part, stop in zip(self.parts, stops, strict=True):
            start = stop - len(part.detection.points)
            features.append(part.describe(chosen[(chosen >= start) & (chosen < stop)] - start))
        return Features.concatenate(features)


def _parts(grey: Grey, options: FeatureOptions) -> Iterator[_Part]:
    """The finest octaves in tiles of the image, and of its halves while these are large; then the rest."""
    whole = np.array(grey.shape[::-1])
    octaves = [_UPSAMPLED, _FIRST]
    while True:
        yield from _tiles(grey, whole / grey.shape[::-1], octaves, options)
        # The finest octave of the half is the second of this one, but less exact.
        octaves = [_FIRST]
        size = (grey.shape[1] // 2, grey.shape[0] // 2)
        grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        if grey.size <= LARGE:
            break
    detection = OpenCVDetection.find(grey, options)
    coarse = np.flatnonzero(_octave(detection) != _UPSAMPLED)
    yield _Part(detection.take(coarse), np.zeros(2, dtype=np.intp), whole / grey.shape[::-1])


def _tiles(grey: Grey, factor: FloatArray, octaves: list[int], options: FeatureOptions) -> Iterator[_Part]:
    """Find the keypoints of some octaves, tile by tile."""
    for y in _intervals(grey.shape[0]):
        for x in _intervals(grey.shape[1]):
            detection = OpenCVDetection.find(grey[y.seen, x.seen], options)
            inside = (
                x.owns(detection.points[:, 0]) & y.owns(detection.points[:, 1]) & np.isin(_octave(detection), octaves)
            )
            yield _Part(detection.take(np.flatnonzero(inside)), np.array([x.seen.start, y.seen.start]), factor)


@dataclass(frozen=True)
class _Interval:
    """The range of a side of the image that a tile covers, and the part it keeps: infinite at the image's border."""

    seen: slice
    start: float
    stop: float

    def owns(self, places: FloatArray) -> NDArray[np.bool_]:
        """Test that places, pixels of the tile, are in the part that it keeps."""
        places = places + self.seen.start
        inside: NDArray[np.bool_] = (places >= self.start) & (places < self.stop)
        return inside


def _intervals(length: int) -> list[_Interval]:
    """The tiles along a side."""
    borders = np.linspace(0, length, -(-length // _SIDE) + 1).astype(int).tolist()
    return [
        _Interval(
            slice(max(0, start - _OVERLAP), min(length, stop + _OVERLAP)),
            start if start > 0 else -np.inf,
            stop if stop < length else np.inf,
        )
        for start, stop in pairwise(borders)
    ]


def _octave(detection: OpenCVDetection) -> NDArray[np.intp]:
    """The octave of each keypoint, as OpenCV packs it."""
    return np.array([keypoint.octave & 255 for keypoint in detection.keypoints], dtype=np.intp)
