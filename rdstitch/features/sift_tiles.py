"""SIFT of large images in tiles, so that memory does not grow with the image.

SIFT's finest octave has four times the pixels of an image. Of a large one the two finest octaves, most of the memory
and most of the keypoints, are found in overlapping tiles, where they are what they would be in the whole; the coarser
ones are those of the image at half its size, and so on.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features.keypoints import Detection, Features
from rdstitch.features.opencv import Grey, detect_opencv
from rdstitch.options.feature_options import FeatureOptions

LARGE = 1_250_000
"""Pixels from which on an image is taken in tiles: a whole one takes 230 bytes a pixel."""

_SIDE = 640  # pixels of a tile without its overlap, at most
# How far the descriptors of the two finest octaves reach, pixels: sigma of 4, times 3 a cell, 2.5 cells, diagonally,
# and what is smoothed there.
_OVERLAP = 64
_UPSAMPLED, _FIRST = 255, 0  # octaves -1 and 0, as OpenCV packs them

_Keypoints = TypeVar("_Keypoints", Detection, Features)


def detect_sift_in_tiles(grey: Grey, options: FeatureOptions) -> Detection:
    """Find keypoints by SIFT in parts of an image, and describe them part by part."""
    parts = list(_parts(grey, options))
    stops = np.cumsum([len(part.points) for part in parts]).tolist()

    def describe(chosen: NDArray[np.intp]) -> Features:
        ranges = zip(parts, [0, *stops[:-1]], stops, strict=True)
        inside = ((part, start, (chosen >= start) & (chosen < stop)) for part, start, stop in ranges)
        return Features.concatenate([part.describe(chosen[mask] - start) for part, start, mask in inside])

    columns = zip(*((part.points, part.scale, part.response) for part in parts), strict=True)
    points, scale, response = map(np.concatenate, columns)
    return Detection(points, scale, response, describe)


def _in_whole(part: Detection, corner: NDArray[np.intp], factor: FloatArray) -> Detection:
    """Keypoints of a tile in pixels of the image itself, of which ``factor`` (2,) are one of the tile.

    ``corner`` (2,) is the tile's in the image that it is cut from. Strengths are contrast times diameter.
    """
    enlargement = float(np.sqrt(factor.prod()))

    def moved(keypoints: _Keypoints) -> _Keypoints:
        points = (keypoints.points + corner + 0.5) * factor - 0.5
        scale, response = keypoints.scale * enlargement, keypoints.response * enlargement
        return replace(keypoints, points=points, scale=scale, response=response)

    return moved(replace(part, describe=lambda chosen: moved(part.describe(chosen))))


def _parts(grey: Grey, options: FeatureOptions) -> Iterator[Detection]:
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
    coarse = detect_opencv(grey, options, range(_UPSAMPLED))
    yield _in_whole(coarse, np.zeros(2, dtype=np.intp), whole / grey.shape[::-1])


def _tiles(grey: Grey, factor: FloatArray, octaves: list[int], options: FeatureOptions) -> Iterator[Detection]:
    """Find the keypoints of some octaves, tile by tile."""
    for y, top, bottom in _intervals(grey.shape[0]):
        for x, left, right in _intervals(grey.shape[1]):
            detection, corner = detect_opencv(grey[y, x], options, octaves), np.array([x.start, y.start])
            places = detection.points + corner
            inside = ((places >= (left, top)) & (places < (right, bottom))).all(axis=1)
            yield _in_whole(detection.take(np.flatnonzero(inside)), corner, factor)


def _intervals(length: int) -> list[tuple[slice, float, float]]:
    """What each tile along a side covers, and from where to where it keeps its keypoints: all beyond the border."""
    borders = np.linspace(0, length, -(-length // _SIDE) + 1).astype(int).tolist()
    covered = [slice(max(0, a - _OVERLAP), min(length, b + _OVERLAP)) for a, b in pairwise(borders)]
    edges = [-np.inf, *borders[1:-1], np.inf]
    return list(zip(covered, edges[:-1], edges[1:], strict=True))
