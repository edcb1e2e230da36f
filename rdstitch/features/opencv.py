"""The detectors that OpenCV brings, in the steps that all detectors take: find, choose, describe."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.features.keypoints import Descriptors, Features
from rdstitch.features.options import FeatureOptions
from rdstitch.process_memory import scratch_memory

Grey = NDArray[np.uint8]

_ROOTSIFT_NORM = 512.0
# Side in pixels below which some detectors raise, and none finds a thing.
_MIN_IMAGE = 16
# Bytes, measured of SIFT: differences of Gaussians of an image of four times the pixels, and of its halves.
_SCRATCH_OF_A_PIXEL = 230


@dataclass(frozen=True, eq=False)
class OpenCVDetection:
    """Keypoints that an OpenCV detector found in an image."""

    detector: Any
    grey: Grey
    keypoints: list[cv2.KeyPoint]
    points: FloatArray
    scale: FloatArray
    response: FloatArray
    kind: str

    @classmethod
    def find(cls, grey: Grey, options: FeatureOptions) -> Self:
        """Find keypoints; see :func:`create_detector` for errors."""
        detector = create_detector(options)
        with scratch_memory(_SCRATCH_OF_A_PIXEL * grey.size):
            keypoints = detector.detect(grey, None) if min(grey.shape) >= _MIN_IMAGE else ()
        table = _table(keypoints, "size", "angle", "octave", "response")
        # OpenCV promises no order: sort, so that the choice among equals is the same everywhere.
        order = np.lexsort(table.T)
        table = table[order]
        return cls(
            detector,
            grey,
            [keypoints[i] for i in order],
            points=table[:, :2],
            scale=table[:, 2],
            response=_strength(options.kind, table[:, 5], table[:, 2]),
            kind=options.kind,
        )

    def take(self, index: NDArray[np.intp]) -> Self:
        """The keypoints of the given indices, in their order."""
        return replace(
            self,
            keypoints=[self.keypoints[i] for i in index],
            points=self.points[index],
            scale=self.scale[index],
            response=self.response[index],
        )

    def describe(self, chosen: NDArray[np.intp]) -> Features:
        """Describe the chosen keypoints; those too near the border for OpenCV drop out."""
        wanted = [self.keypoints[i] for i in chosen]
        with scratch_memory(_SCRATCH_OF_A_PIXEL * self.grey.size):
            described, descriptors = self.detector.compute(self.grey, wanted) if wanted else ((), None)
        if descriptors is None:
            dtype = np.float32 if self.detector.descriptorType() == cv2.CV_32F else np.uint8
            descriptors = np.zeros((0, self.detector.descriptorSize()), dtype)
        u, v, size, degrees, response = _table(described, "size", "angle", "response").T
        return Features(
            points=np.column_stack([u, v]),
            descriptors=to_rootsift(descriptors) if self.kind == "rootsift" else cast(Descriptors, descriptors),
            scale=size,
            # OpenCV marks "no orientation" by -1.
            angle=np.where(degrees < 0, 0.0, np.radians(degrees) % (2 * np.pi)),
            response=_strength(self.kind, response, size),
            laplacian_sign=None,
            kind=self.kind,
        )


def _table(keypoints: Sequence[cv2.KeyPoint], *names: str) -> FloatArray:
    """Places and attributes of keypoints, (N, 2 + number of names)."""
    table = np.empty((len(keypoints), 2 + len(names)))
    if len(keypoints):
        table[:, :2] = cv2.KeyPoint.convert(keypoints)
    for column, name in enumerate(names, start=2):
        table[:, column] = [getattr(keypoint, name) for keypoint in keypoints]
    return table


def create_detector(options: FeatureOptions) -> Any:
    """Make the OpenCV detector of a kind of features."""
    kind = options.kind
    try:
        if kind in ("sift", "rootsift"):
            # Without the precise upscale all points are a quarter of a pixel off.
            return cv2.SIFT.create(nfeatures=0, contrastThreshold=options.sift_contrast, enable_precise_upscale=True)
        if kind == "orb":
            # Many more than wanted, because ORB keeps the strongest of the whole image and we spread them.
            return cv2.ORB.create(nfeatures=8 * options.limits[0], fastThreshold=options.orb_fast_threshold)
        # OpenCV 5 moved it to xfeatures2d.
        namespace: Any = cv2 if hasattr(cv2, "AKAZE_create") else cv2.xfeatures2d
        return namespace.AKAZE_create(threshold=options.akaze_threshold)
    except (AttributeError, cv2.error) as error:
        raise ArgumentError(
            f"features {options.kind!r} are not in this OpenCV ({cv2.__version__}); choose others"
        ) from error


def to_rootsift(descriptors: Descriptors) -> NDArray[np.float32]:
    """RootSIFT (Arandjelović and Zisserman, CVPR 2012): square roots of the L1-normalized descriptor, norm 512.

    Rounded to integers like SIFT's own, which loses nothing measurable and keeps distances exact.
    """
    values = descriptors.astype(np.float32)
    total = np.maximum(values.sum(axis=1, keepdims=True), np.float32(1.0))
    rooted: NDArray[np.float32] = np.rint(np.sqrt(values / total) * np.float32(_ROOTSIFT_NORM))
    return rooted


def _strength(kind: str, response: FloatArray, size: FloatArray) -> FloatArray:
    """Strengths by which keypoints are chosen.

    For SIFT contrast times size: by contrast alone the choice is mostly tiny ones, which drown in noise. On real pairs
    of images the product gives a fifth to a half more inliers, among other detectors it does not help.
    """
    return response * size if kind in ("sift", "rootsift") else response
