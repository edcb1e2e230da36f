"""Feature detection: pictures in, keypoints with descriptors out."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from rdstitch.errors import ArgumentError
from rdstitch.features.detection import Detection, find
from rdstitch.features.keypoints import Features
from rdstitch.features.options import CLOSER, KINDS, FeatureOptions
from rdstitch.features.picture import Mask, PixelArray, PreparedPicture, View, prepare
from rdstitch.features.spread import spread, strongest
from rdstitch.opencv_state import one_opencv_thread

__all__ = ["KINDS", "DetectionCache", "FeatureOptions", "Features", "View", "ViewLoader", "detect", "detect_all"]

Found = TypeVar("Found")

DetectionCache = Callable[[int, Callable[[], Features]], Found]
"""Called with a picture's index and what detects its features; gives these, perhaps from an earlier run, or what
stands for them where the picture cannot be read."""

ViewLoader = Callable[[float | None], View]
"""Loads one picture when it is called with the 10⁶ pixels that are needed of it; None: all. More pixels may come."""

_FEW = 0.5  # of the keypoints wanted: where a reduced picture shows fewer, a larger one is used


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


def _detect(source: ViewLoader, options: FeatureOptions) -> Features:
    """The same for a picture that is loaded as large as it is needed."""
    most, megapixels = options.limits
    picture, detection, usable = _look(source, options, megapixels)
    if megapixels is not None and picture.reduced and len(usable) < _FEW * most:
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


@overload
def detect_all(
    sources: Sequence[ViewLoader],
    options: FeatureOptions | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> list[Features]: ...


@overload
def detect_all(
    sources: Sequence[ViewLoader],
    options: FeatureOptions | None,
    workers: int,
    progress: Callable[[int, int], None] | None,
    recall: DetectionCache[Found],
) -> list[Found]: ...


def detect_all(
    sources: Sequence[ViewLoader],
    options: FeatureOptions | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
    recall: DetectionCache[Found] | None = None,
) -> list[Features] | list[Found]:
    """Detect the features of many pictures, several at a time; at most ``workers`` pictures are in memory.

    Parameters
    ----------
    sources : sequence of callable
        Each loads one picture; see :data:`ViewLoader`.
    options : FeatureOptions, optional
    workers : int
        Pictures to work on at the same time, each in one thread.
    progress : callable, optional
        Called in this thread with the number of pictures done and their total.
    recall : callable, optional
        Stands between this function and the detection of each picture; see :data:`DetectionCache`. Called in other
        threads.

    Returns
    -------
    list of Features
        In the order of ``sources``; or what ``recall`` gave for each.

    Raises
    ------
    ArgumentError
        As :func:`detect`.
    Exception
        What a source raises; of several, that of the first source.
    """
    options = (options or FeatureOptions()).for_pictures(len(sources))
    if workers < 1:
        raise ArgumentError(f"workers must be at least 1, not {workers}")

    def work(index: int) -> Features | Found:
        compute = partial(_detect, sources[index], options)
        return compute() if recall is None else recall(index, compute)

    results: list[Any] = []
    with one_opencv_thread(), ThreadPoolExecutor(workers) as pool:
        for features in pool.map(work, range(len(sources))):
            results.append(features)
            if progress is not None:
                progress(len(results), len(sources))
    return results
