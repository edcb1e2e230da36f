"""Feature detection: pictures in, keypoints with descriptors out."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.errors import ArgumentError
from rdstitch.features.detection import Detection, find
from rdstitch.features.keypoints import Features
from rdstitch.features.options import CLOSER, KINDS, FeatureOptions
from rdstitch.features.picture import Image, Mask, Picture, prepare
from rdstitch.features.spread import spread, strongest

__all__ = ["KINDS", "FeatureOptions", "Features", "Recall", "Source", "detect", "detect_all"]

Recall = Callable[[int, Callable[[], Features]], Features]
"""Called with a picture's index and what detects its features; gives these, perhaps from an earlier run."""

Source = Callable[[], tuple[Image, Mask | None]]
"""Loads one picture and its mask (True or non-zero: use it; None: use all) when it is called."""

_FEW = 0.5  # of the keypoints wanted: where a reduced picture shows fewer, it is looked at more closely


def detect(image: Image, options: FeatureOptions | None = None, mask: Mask | None = None) -> Features:
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
        Points in px of ``image``, strongest first; none for a blank picture. The same for the same picture,
        whatever the number of threads.

    Raises
    ------
    ArgumentError
        When the picture or the mask has the wrong shape or type, or when this OpenCV lacks the detector.
    """
    options = options or FeatureOptions()
    picture, detection, usable = _look(image, mask, options, options.work_megapixels)
    if options.work_megapixels is not None and picture.reduced and len(usable) < _FEW * options.max_features:
        picture, detection, usable = _look(image, mask, options, CLOSER * options.work_megapixels)
    points, response = detection.points[usable], detection.response[usable]
    if options.spread:
        cell = options.spread_cell * float(np.hypot(*picture.grey.shape))
        chosen = spread(points, response, options.max_features, cell)
    else:
        chosen = strongest(response, options.max_features)
    features = detection.describe(usable[chosen])
    # Some detectors return them in an order of their own.
    features = features.take(strongest(features.response, len(features)))
    scale = features.scale * float(np.sqrt(picture.factor.prod()))
    size = (image.shape[1], image.shape[0])
    return replace(features, points=picture.to_full_size(features.points), scale=scale, image_size=size)


def _look(
    image: Image, mask: Mask | None, options: FeatureOptions, megapixels: float | None
) -> tuple[Picture, Detection, NDArray[np.intp]]:
    """A picture at most so large, what is found in it, and which of that lies where it may."""
    picture = prepare(image, mask, megapixels)
    detection = find(picture.grey, options)
    return picture, detection, np.flatnonzero(picture.covers(detection.points, detection.scale / 2))


def detect_all(
    sources: Sequence[Source],
    options: FeatureOptions | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
    recall: Recall | None = None,
) -> list[Features]:
    """Detect the features of many pictures, several at a time; at most ``workers`` pictures are in memory.

    Parameters
    ----------
    sources : sequence of callable
        Each loads one picture and its mask.
    options : FeatureOptions, optional
    workers : int
        Pictures to work on at the same time, each in one thread.
    progress : callable, optional
        Called in this thread with the number of pictures done and their total.
    recall : callable, optional
        Stands between this function and the detection of each picture; see :data:`Recall`. Called in other threads.

    Returns
    -------
    list of Features
        In the order of ``sources``.

    Raises
    ------
    ArgumentError
        As :func:`detect`.
    Exception
        What a source raises; of several, that of the first source.
    """
    options = options or FeatureOptions()
    if workers < 1:
        raise ArgumentError(f"workers must be at least 1, not {workers}")

    def find_features(source: Source) -> Features:
        image, mask = source()
        return detect(image, options, mask)

    def work(index: int) -> Features:
        compute = partial(find_features, sources[index])
        return compute() if recall is None else recall(index, compute)

    results: list[Features] = []
    with _one_opencv_thread(), ThreadPoolExecutor(workers) as pool:
        for features in pool.map(work, range(len(sources))):
            results.append(features)
            if progress is not None:
                progress(len(results), len(sources))
    return results


@contextmanager
def _one_opencv_thread() -> Iterator[None]:
    """Keep OpenCV from starting threads of its own while we run several pictures at a time."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
