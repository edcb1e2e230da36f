"""Learned features and their matcher, from ONNX files that the user supplies: ALIKED and LightGlue by OpenCV 5.

ALIKED: Zhao et al., IEEE TIM 2023. LightGlue: Lindenberger et al., ICCV 2023. The files are exports such as
OpenCV's own tests use: ALIKED takes ``image`` and gives ``keypoints``, ``descriptors``, ``scores``; LightGlue takes
``kpts0``, ``kpts1``, ``desc0``, ``desc1`` and gives ``matches0``, ``mscores0``.
"""

import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.errors import ArgumentError, InputError
from rdstitch.features.keypoints import Correspondences, Detection, Features
from rdstitch.options.feature_options import FeatureOptions
from rdstitch.system.native_threads import silent_opencv


def detect_aliked(grey: NDArray[np.uint8], options: FeatureOptions) -> Detection:
    """Find keypoints by ALIKED, which describes all of them at once, and at but one scale."""
    assert options.aliked_model is not None
    network = _load("ALIKED", options.aliked_model, _aliked_parameters(options.aliked_size))
    try:
        keypoints, descriptors = network.detectAndCompute(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), None)
    except cv2.error as error:
        raise InputError(f"{options.aliked_model}: not an ALIKED network that OpenCV can run") from error
    rows = np.array([(*k.pt, k.response) for k in keypoints], dtype=np.float64).reshape(-1, 3)
    if descriptors is None:
        descriptors = np.zeros((0, network.descriptorSize()))
    finite = np.isfinite(rows).all(axis=1)
    rows, described = rows[finite], np.asarray(descriptors, np.float32)[finite]
    points, response, ones = rows[:, :2], rows[:, 2], np.ones(len(rows))
    features = Features(points, described, ones, np.zeros(len(rows)), response, None, kind="aliked")
    return Detection(points, ones, response, features.take)


class LightGlue:
    """Matches learned features by a network that sees all keypoints of both images at once.

    ``model`` is an ONNX file, trained for the kind of features to match; ``min_score`` the least confidence, in [0, 1).
    """

    def __init__(self, model: str | Path, min_score: float = 0.1) -> None:
        self._model, self._min_score = Path(model), min_score
        self._matcher = _load("LightGlueMatcher", self._model, min_score)
        # The pair to match is the matcher's state: one thread at a time.
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[Callable[[Path, float], "LightGlue"], tuple[Path, float]]:
        """Other processes load the network once."""
        return _loaded_once, (self._model, self._min_score)

    def match(self, features1: Features, features2: Features) -> Correspondences:
        """Match the features of two images, the most certain first.

        Where the matcher by distances gives the ratio of distances, this one gives one minus its confidence.
        """
        if features1.image_size is None or features2.image_size is None:
            raise ArgumentError("LightGlue needs to know the sizes of the images")
        if len(features1) == 0 or len(features2) == 0:
            return Correspondences.of(features1, features2, np.zeros((0, 2), np.intp), np.zeros(0))
        try:
            with self._lock:
                self._matcher.setPairInfo(
                    features1.points.astype(np.float32),
                    features2.points.astype(np.float32),
                    features1.image_size,
                    features2.image_size,
                )
                matched = self._matcher.match(features1.descriptors, features2.descriptors)
        except cv2.error as error:
            raise InputError(f"{self._model}: not a LightGlue network for {features1.kind} features") from error
        rows = np.array([(m.queryIdx, m.trainIdx) for m in matched], dtype=np.intp).reshape(-1, 2)
        doubt = np.clip(np.array([m.distance for m in matched], dtype=np.float64), 0.0, 1.0)
        order = np.lexsort((rows[:, 1], rows[:, 0], doubt))
        return Correspondences.of(features1, features2, rows[order], doubt[order])


@cache
def _loaded_once(model: Path, min_score: float) -> LightGlue:
    return LightGlue(model, min_score)


def _load(name: str, model: str | Path, *arguments: Any) -> Any:
    """``cv2.<name>.create(model, …)`` with errors that say what is wrong."""
    path = Path(model)
    if not hasattr(cv2, name):
        raise ArgumentError(f"this OpenCV ({cv2.__version__}) has no {name}; OpenCV 5 has")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        # OpenCV logs that its new engine has no targets; users cannot do anything about it.
        with silent_opencv():
            return getattr(cv2, name).create(str(path), *arguments)
    except cv2.error as error:
        raise InputError(f"{path}: not an ONNX file that OpenCV can read") from error


def _aliked_parameters(size: int) -> Any:
    """``cv2.ALIKED.Params`` for a network with square input."""
    if not hasattr(cv2, "ALIKED"):
        return None
    parameters = cv2.ALIKED.Params()
    parameters.inputSize = (size, size)
    return parameters
