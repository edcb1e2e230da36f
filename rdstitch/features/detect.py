"""Feature detection: pictures in, keypoints with descriptors out."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rdstitch.features.detection import Detection, find
from rdstitch.features.keypoints import Features
from rdstitch.features.options import CLOSER, KINDS, FeatureOptions
from rdstitch.features.picture import Mask, PixelArray, PreparedPicture, View, prepare
from rdstitch.features.spread import spread, strongest
from rdstitch.opencv_state import one_opencv_thread

__all__ = ["KINDS", "FeatureOptions", "Features", "View", "ViewLoader", "detect", "detect_view"]

ViewLoader = Callable[[float | None], View]
"""Loads one picture when it is called with the 10⁶ pixels that are needed of it; None: all. More pixels may come."""

_MIN_KEYPOINT_SHARE = 0.5  # of the keypoints wanted: where a reduced picture shows fewer, a larger one is used


def detect(image: PixelArray, options: FeatureOptions | None = None, mask: Mask | None = None) -> Features:
    """Detect and describe the features of one picture.

    Parameters
    ----------
    image : ndarray of shape (height, width) or (height, width, 1 to 4)
        Grey, grey with alpha, RGB or RGB with alpha; uint8, or uint16 or float, which are stretched to 8
        bits. Nothing is detected where alpha is zero or a float is not finite.
    options : FeatureOptions, optional
    mask : ndarray of shape (height, width), bool or uint8, optional
        Where to look: True, or not zero. A keypoint whose extent reaches into the rest is dropped.

    Returns
    -------
    Features
        Points in pixels of ``image``, strongest first; none for a blank picture. The same for the same picture,
        whatever the number of threads.

    Raises
    ------
    ArgumentError
        When the picture or the mask has the wrong shape or type, or when this OpenCV lacks the detector.
    """
    return _detect(lambda _: View(image, mask), options or FeatureOptions())


def detect_view(source: ViewLoader, options: FeatureOptions) -> Features:
    """As :func:`detect`, in one thread, for a picture that is loaded as large as it is needed.

    Parameters
    ----------
    source : callable
        See :data:`ViewLoader`.
    options : FeatureOptions

    Raises
    ------
    ArgumentError
        As :func:`detect`.
    Exception
        What the source raises.
    """
    with one_opencv_thread():
        return _detect(source, options)


def _detect(source: ViewLoader, options: FeatureOptions) -> Features:
    """The same for a picture that is loaded as large as it is needed."""
    most, megapixels = options.limits
    picture, detection, usable = _look(source, options, megapixels)
    if megapixels is not None and picture.reduced and len(usable) < _MIN_KEYPOINT_SHARE * most:
        picture, detection, usable = _look(source, options, CLOSER * megapixels)
    points, response = detection.points[usable], detection.response[usable]
    if options.spread:
        cell = options.spread_cell * float(np.hypot(*picture.grey.shape))
        chosen = spread(points, response, most, cell)
    else:
        chosen = strongest(response, most)
    features = detection.describe(usable[chosen])
    # Some detectors return them in an order of their own.
    features = features.take(strongest(features.response, len(features)))
    scale = features.scale * float(np.sqrt(picture.factor.prod()))
    return replace(features, points=picture.to_full_size(features.points), scale=scale, image_size=picture.full_size)


def _look(
    source: ViewLoader, options: FeatureOptions, megapixels: float | None
) -> tuple[PreparedPicture, Detection, NDArray[np.intp]]:
    """The picture at most so large, what is found in it, and which of that may count."""
    picture = prepare(source(megapixels), megapixels, stretch=options.stretch, equalize=bool(options.equalize))
    detection = find(picture.grey, options)
    usable = np.flatnonzero(picture.covers(detection.points, detection.scale / 2))
    return picture, detection, usable
