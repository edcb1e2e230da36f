"""The detectors that OpenCV brings, behind one interface: detect, choose, describe."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.errors import ArgumentError
from rdstitch.features.keypoints import Descriptors, Features
from rdstitch.features.options import FeatureOptions

Grey = NDArray[np.uint8]

_ROOTSIFT_SCALE = 512.0


def create_detector(options: FeatureOptions) -> Any:
    """Make the OpenCV detector for ``options.kind``.

    Raises
    ------
    ArgumentError
        When this OpenCV lacks it. Builds differ, and a name may be there that only raises: so it is called.
    """
    kind = "sift" if options.kind == "rootsift" else options.kind
    try:
        return _FACTORIES[kind](options)
    except (AttributeError, cv2.error) as error:
        raise ArgumentError(
            f"features {options.kind!r} are not in this OpenCV ({cv2.__version__}); choose others"
        ) from error


def _sift(options: FeatureOptions) -> Any:
    # Without the precise upscale all points are a quarter of a pixel off.
    return cv2.SIFT.create(nfeatures=0, contrastThreshold=options.sift_contrast, enable_precise_upscale=True)


def _orb(options: FeatureOptions) -> Any:
    # Many more than asked for, because ORB keeps the strongest of the whole picture and we spread them.
    return cv2.ORB.create(nfeatures=8 * options.max_features, fastThreshold=options.orb_fast_threshold)


def _moved(name: str) -> Callable[[FeatureOptions], Any]:
    """Factory of a detector that OpenCV 5 moved to ``cv2.xfeatures2d``."""

    def create(_options: FeatureOptions) -> Any:
        module = cv2 if hasattr(cv2, name) else cv2.xfeatures2d
        return getattr(module, name)()

    return create


_FACTORIES: dict[str, Callable[[FeatureOptions], Any]] = {
    "sift": _sift,
    "orb": _orb,
    "akaze": _moved("AKAZE_create"),
    "kaze": _moved("KAZE_create"),
    "brisk": _moved("BRISK_create"),
}


def describe(detector: Any, grey: Grey, keypoints: Sequence[cv2.KeyPoint], kind: str) -> Features:
    """Describe chosen keypoints; those that OpenCV cannot describe, at the border, drop out.

    Points and scales are in px of ``grey``.
    """
    described, descriptors = detector.compute(grey, list(keypoints)) if keypoints else ((), None)
    if descriptors is None:
        dtype = np.float32 if detector.descriptorType() == cv2.CV_32F else np.uint8
        values = cast(Descriptors, np.zeros((0, detector.descriptorSize()), dtype))
    else:
        values = descriptors
    columns = np.array([(*k.pt, k.size, k.angle, k.response) for k in described], dtype=np.float64).reshape(-1, 5)
    return Features(
        points=np.ascontiguousarray(columns[:, :2]),
        descriptors=root(values) if kind == "rootsift" else values,
        scale=columns[:, 2].copy(),
        # OpenCV marks "no orientation" by -1.
        angle=np.where(columns[:, 3] < 0, 0.0, np.radians(columns[:, 3]) % (2 * np.pi)),
        response=columns[:, 4].copy(),
        laplacian_sign=None,
        kind=kind,
    )


def root(descriptors: Descriptors) -> NDArray[np.float32]:
    """RootSIFT (Arandjelović and Zisserman 2012): square roots of the L1-normalized descriptor, norm 512.

    Rounded to integers like SIFT's own, which loses nothing measurable and makes distances exact in float32.
    """
    values = descriptors.astype(np.float32)
    total = np.maximum(values.sum(axis=1, keepdims=True), np.float32(1.0))
    rooted: NDArray[np.float32] = np.rint(np.sqrt(values / total) * np.float32(_ROOTSIFT_SCALE))
    return rooted
