"""The detectors that OpenCV brings, in the steps that all detectors take: find, choose, describe."""

from collections.abc import Sequence
from operator import attrgetter
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.features.keypoints import Descriptors, Detection, Features
from rdstitch.options.feature_options import FeatureOptions
from rdstitch.system.process_memory import scratch_memory

Grey = NDArray[np.uint8]

SIFT_CONTRAST = 0.02
"""SIFT's contrast threshold; 0.04 is OpenCV's, too high for hazy images."""

_ORB_FAST_THRESHOLD = 7  # grey levels by which a corner must differ from its surroundings
_AKAZE_THRESHOLD = 0.0005  # least response; 0.001 is OpenCV's
_ROOTSIFT_NORM = 512.0
# Side in pixels below which some detectors raise, and none finds a thing.
_MIN_IMAGE = 16
# Bytes, measured of SIFT: differences of Gaussians of an image of four times the pixels, and of its halves.
_SCRATCH_OF_A_PIXEL = 230


def detect_opencv(grey: Grey, options: FeatureOptions, octaves: Sequence[int] | None = None) -> Detection:
    """Find keypoints, all or those of some octaves as OpenCV packs them; see :func:`create_detector` for errors."""
    detector, of_sift = create_detector(options), options.kind in ("sift", "rootsift")
    with scratch_memory(_SCRATCH_OF_A_PIXEL * grey.size):
        keypoints = detector.detect(grey, None) if min(grey.shape) >= _MIN_IMAGE else ()
    table = _table(keypoints, "size", "angle", "octave", "response")
    # OpenCV promises no order: sort, so that the choice among equals is the same everywhere.
    order = np.lexsort(table.T)
    if octaves is not None:
        order = order[np.isin(table[order, 4].astype(np.intp) & 255, octaves)]
    table, ordered = table[order], [keypoints[i] for i in order]

    def describe(chosen: NDArray[np.intp]) -> Features:
        """Features of keypoints of some indices, without those too near the border for OpenCV."""
        wanted = [ordered[i] for i in chosen]
        with scratch_memory(_SCRATCH_OF_A_PIXEL * grey.size):
            described, descriptors = detector.compute(grey, wanted) if wanted else ((), None)
        if descriptors is None:
            dtype = np.float32 if detector.descriptorType() == cv2.CV_32F else np.uint8
            descriptors = np.zeros((0, detector.descriptorSize()), dtype)
        table = _table(described, "size", "angle", "response")
        points, (size, degrees, response) = table[:, :2].copy(), table[:, 2:].T
        return Features(
            points=points,
            descriptors=to_rootsift(descriptors) if options.kind == "rootsift" else cast(Descriptors, descriptors),
            scale=size,
            # OpenCV marks "no orientation" by -1.
            angle=np.where(degrees < 0, 0.0, np.radians(degrees) % (2 * np.pi)),
            response=response * size if of_sift else response,
            laplacian_sign=_laplacian_sign(grey, points, size) if of_sift else None,
            kind=options.kind,
        )

    # For SIFT contrast times size: by contrast alone the choice is mostly tiny ones, which drown in noise. On real
    # pairs the product gives a fifth to a half more inliers, among other detectors it does not help.
    response = table[:, 5] * table[:, 2] if of_sift else table[:, 5]
    return Detection(table[:, :2], table[:, 2], response, describe)


def _laplacian_sign(grey: Grey, points: FloatArray, size: FloatArray) -> NDArray[np.int8]:
    """+1 for dark blobs, -1 for light ones: extrema of one kind of SIFT's differences of Gaussians, (N,).

    OpenCV keeps it to itself. Boxes stand for the two Gaussians; of 2,000 keypoints they get none or one wrong.
    """
    sums, last = cv2.integral(grey), np.array(grey.shape[::-1]) - 1

    def mean(radius: FloatArray) -> FloatArray:
        """Mean grey level of the boxes around all points, cut off at the border of the image."""
        (u1, v1), (u2, v2) = (
            np.clip(np.rint(points + side * radius[:, None]), 0, last).astype(np.intp).T + (side > 0)
            for side in (-1, 1)
        )
        total = sums[v2, u2] - sums[v1, u2] - sums[v2, u1] + sums[v1, u1]
        return np.asarray(total / ((u2 - u1) * (v2 - v1)))

    return np.where(mean(size / 2) < mean(size), 1, -1).astype(np.int8)


def _table(keypoints: Sequence[cv2.KeyPoint], *names: str) -> FloatArray:
    """Places and attributes of keypoints, (N, 2 + number of names)."""
    table = np.empty((len(keypoints), 2 + len(names)))
    if len(keypoints):
        table[:, :2] = cv2.KeyPoint.convert(keypoints)
    for column, name in enumerate(names, start=2):
        table[:, column] = np.fromiter(map(attrgetter(name), keypoints), np.float64, len(keypoints))
    return table


def create_detector(options: FeatureOptions) -> Any:
    """Make the OpenCV detector of a kind of features."""
    try:
        if options.kind == "orb":
            # Many more than wanted, because ORB keeps the strongest of the whole image and we spread them.
            return cv2.ORB.create(nfeatures=8 * options.limits[0], fastThreshold=_ORB_FAST_THRESHOLD)
        if options.kind == "akaze":
            # OpenCV 5 moved it to xfeatures2d.
            namespace: Any = cv2 if hasattr(cv2, "AKAZE_create") else cv2.xfeatures2d
            return namespace.AKAZE_create(threshold=_AKAZE_THRESHOLD)
        # Without the precise upscale all points are a quarter of a pixel off.
        return cv2.SIFT.create(nfeatures=0, contrastThreshold=SIFT_CONTRAST, enable_precise_upscale=True)
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
    return np.asarray(np.rint(np.sqrt(values / total) * np.float32(_ROOTSIFT_NORM)))
