"""Feature detection, alike for all detectors: they find keypoints, some are chosen, and those are described."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.choices import FeatureName
from rdstitch.features.keypoints import Detection, Features
from rdstitch.features.learned import detect_aliked
from rdstitch.features.opencv import detect_opencv
from rdstitch.features.prepared_image import CLIP_LIMIT, Mask, PixelArray, PreparedImage, View, prepare
from rdstitch.features.sift_tiles import LARGE, detect_sift_in_tiles
from rdstitch.features.surf.descriptor import detect_surf
from rdstitch.options.feature_options import CLOSER, FeatureOptions

_MIN_KEYPOINT_FRACTION = 0.5  # of the keypoints wanted: where a reduced image shows fewer, a larger one is used
_SPREAD_CELL = 0.05  # side of a cell over which keypoints are spread, diagonals of the image
# Fraction of the keypoints that must be seen at less contrast, too; of fewer, contrast is what is missing.
_LASTING = 0.5


def _detect_sift(grey: NDArray[np.uint8], options: FeatureOptions) -> Detection:
    return detect_sift_in_tiles(grey, options) if grey.size > LARGE else detect_opencv(grey, options)


_DETECTORS: dict[FeatureName, Callable[[NDArray[np.uint8], FeatureOptions], Detection]] = {
    "rootsift": _detect_sift,
    "sift": _detect_sift,
    "surf": lambda grey, _: detect_surf(grey),
    "orb": detect_opencv,
    "akaze": detect_opencv,
    "aliked": detect_aliked,
}


def strongest(response: FloatArray, count: int) -> NDArray[np.intp]:
    """Indices of the ``count`` strongest keypoints, strongest first, ties in input order."""
    return np.argsort(-response, kind="stable")[:count]


def spread(points: FloatArray, response: FloatArray, count: int, cell: float) -> NDArray[np.intp]:
    """Indices of ``count`` keypoints at most (N, 2) that are spread over the image, strongest first.

    The cells of a grid, ``cell`` pixels a side, take turns, each giving its strongest keypoint that is left: the
    corners, where the distortion is seen, keep what they have however strong the middle of the image is.
    """
    if len(points) <= count:
        return strongest(response, count)
    column, row = np.floor(points / cell).astype(np.int64).T
    by_cell = np.lexsort((-response, column, row))
    is_first = np.ones(len(points), dtype=bool)
    is_first[1:] = (np.diff(column[by_cell]) != 0) | (np.diff(row[by_cell]) != 0)
    starts = np.flatnonzero(is_first)
    turn = np.arange(len(points)) - np.repeat(starts, np.diff(np.append(starts, len(points))))
    kept = by_cell[np.lexsort((by_cell, -response[by_cell], turn))[:count]]
    return kept[strongest(response[kept], count)]


ViewLoader = Callable[[float | None], View]
"""Loads one image when it is called with the 10⁶ pixels that are needed of it; None: all. More pixels may come."""


def detect(image: PixelArray, options: FeatureOptions | None = None, mask: Mask | None = None) -> Features:
    """Detect and describe the features of one image: the same whatever the number of threads, strongest first.

    The image is grey or RGB, with alpha or without; uint16 and float are stretched to 8 bits. No keypoint reaches into
    places where alpha is zero, a float is not finite, or the mask is False or zero.
    """
    return detect_view(lambda _: View.of(image, mask), options or FeatureOptions())


def detect_view(load: ViewLoader, options: FeatureOptions) -> Features:
    """Detect and describe the features of an image that is loaded as large as it is needed; see :func:`detect`."""
    most, megapixels = options.limits
    image, detection, usable = _find(load, options, megapixels)
    detected_count, few = len(usable), len(usable) < _MIN_KEYPOINT_FRACTION * most
    low_contrast = few and _has_low_contrast(image, detected_count, options)
    if megapixels is not None and image.reduced and few:
        image, detection, usable = _find(load, options, CLOSER * megapixels)
    points, response = detection.points[usable], detection.response[usable]
    if options.spread:
        cell = _SPREAD_CELL * float(np.hypot(*image.grey.shape))
        chosen = spread(points, response, most, cell)
    else:
        chosen = strongest(response, most)
    features = detection.describe(usable[chosen])
    # Some detectors return them in an order of their own.
    features = features.take(strongest(features.response, len(features)))
    return replace(
        features,
        points=image.to_full_size(features.points),
        scale=features.scale * float(np.sqrt(image.factor.prod())),
        image_size=image.full_size,
        detected_count=detected_count,
        low_contrast=low_contrast,
    )


def _find(
    load: ViewLoader, options: FeatureOptions, megapixels: float | None
) -> tuple[PreparedImage, Detection, NDArray[np.intp]]:
    """The image at most so large, the keypoints detected in it, and which of them keep clear of the mask."""
    image = prepare(load(megapixels), megapixels, stretch=options.stretch, equalize=bool(options.equalize))
    detection = _DETECTORS[options.kind](image.grey, options)
    return image, detection, _usable(image, detection)


def _has_low_contrast(image: PreparedImage, detected_count: int, options: FeatureOptions) -> bool:
    """Whether most keypoints vanish where contrast is divided by the most that equalization multiplies it by."""
    weakened = np.rint(image.grey / CLIP_LIMIT).astype(np.uint8)
    return len(_usable(image, _DETECTORS[options.kind](weakened, options))) <= _LASTING * detected_count


def _usable(image: PreparedImage, detection: Detection) -> NDArray[np.intp]:
    """Select the keypoints that keep clear of the mask."""
    return np.flatnonzero(image.covers(detection.points, detection.scale / 2))
