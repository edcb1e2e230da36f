"""The detectors that OpenCV brings, in the steps that all detectors take: find, choose, describe.

SIFT takes a large picture in strips, in a third of the memory: its finest octave has four times the picture's pixels.
The two finest octaves, most of the memory and most of the keypoints, are found in overlapping strips, where they are
what they would be in the whole; the coarser ones are those of the picture at half its size.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.features.keypoints import Descriptors, Features
from rdstitch.features.options import FeatureOptions

Grey = NDArray[np.uint8]

_ROOTSIFT_NORM = 512.0
# Side in pixels below which some detectors raise, and none finds a thing.
_MIN_PICTURE = 16


@dataclass(frozen=True, eq=False)
class OpenCVDetection:
    """Keypoints that an OpenCV detector found in a picture."""

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
        keypoints = detector.detect(grey, None) if min(grey.shape) >= _MIN_PICTURE else ()
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
    """Make the OpenCV detector of a kind of features.

    Raises
    ------
    ArgumentError
        When this OpenCV lacks it. Builds differ, and a name may be there that only raises: so it is called.
    """
    try:
        return _FACTORIES[options.kind](options)
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
    """By which keypoints are chosen.

    For SIFT contrast times size: by contrast alone the choice is mostly tiny ones, which drown in noise. On real pairs
    of pictures the product gives a fifth to a half more inliers, among other detectors it does not help.
    """
    return response * size if kind in ("sift", "rootsift") else response


def _sift(options: FeatureOptions) -> Any:
    # Without the precise upscale all points are a quarter of a pixel off.
    return cv2.SIFT.create(nfeatures=0, contrastThreshold=options.sift_contrast, enable_precise_upscale=True)


def _orb(options: FeatureOptions) -> Any:
    # Many more than wanted, because ORB keeps the strongest of the whole picture and we spread them.
    return cv2.ORB.create(nfeatures=8 * options.limits[0], fastThreshold=options.orb_fast_threshold)


def _akaze(options: FeatureOptions) -> Any:
    return _moved("AKAZE_create")(threshold=options.kaze_threshold)


def _kaze(options: FeatureOptions) -> Any:
    return _moved("KAZE_create")(threshold=options.kaze_threshold)


def _brisk(options: FeatureOptions) -> Any:
    return _moved("BRISK_create")(thresh=options.brisk_threshold)


def _moved(name: str) -> Callable[..., Any]:
    """Factory of a detector that OpenCV 5 moved to ``cv2.xfeatures2d``."""
    factory: Callable[..., Any] = getattr(cv2 if hasattr(cv2, name) else cv2.xfeatures2d, name)
    return factory


_FACTORIES: dict[str, Callable[[FeatureOptions], Any]] = {
    "rootsift": _sift,
    "sift": _sift,
    "orb": _orb,
    "akaze": _akaze,
    "kaze": _kaze,
    "brisk": _brisk,
}


LARGE = 1_500_000
"""Px from which on a picture is taken in strips."""

_STRIP_PIXELS = 400_000  # pixels of a strip without its overlap, about
# How far the descriptors of the two finest octaves reach, pixels: sigma of 4, times 3 a cell, 2.5 cells, diagonally,
# and what is smoothed there.
_OVERLAP = 64
_FINEST = (255, 0)  # octaves -1 and 0, as OpenCV packs them


@dataclass(frozen=True, eq=False)
class _Part:
    """Keypoints of a strip that begins ``top`` pixels down, or of a picture that is smaller by ``factor``."""

    detection: OpenCVDetection
    top: int
    factor: int

    @property
    def points(self) -> FloatArray:
        """Places in the whole picture, pixels."""
        return self._in_whole(self.detection.points)

    def describe(self, chosen: NDArray[np.intp]) -> Features:
        """Features in pixels of the whole picture."""
        found = self.detection.describe(chosen)
        return replace(
            found,
            points=self._in_whole(found.points),
            scale=found.scale * self.factor,
            response=found.response * self.factor,
        )

    def _in_whole(self, points: FloatArray) -> FloatArray:
        return (points + 0.5) * self.factor - 0.5 + (0.0, self.top)


@dataclass(frozen=True, eq=False)
class StripsDetection:
    """Keypoints of a picture, found in parts of it."""

    parts: tuple[_Part, ...]

    @classmethod
    def find(cls, grey: Grey, options: FeatureOptions) -> Self:
        """Find the keypoints of a picture by SIFT."""
        size = (grey.shape[1] // 2, grey.shape[0] // 2)
        half = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        coarse = OpenCVDetection.find(half, options)
        # The finest octave of the small picture is the second of the large one, but less exact.
        coarse = coarse.take(np.flatnonzero(~_in_octaves(coarse, _FINEST[:1])))
        return cls((*_strips(grey, options), _Part(coarse, 0, 2)))

    @property
    def points(self) -> FloatArray:
        """Places, pixels of the picture, (N, 2)."""
        return np.concatenate([part.points for part in self.parts])

    @property
    def scale(self) -> FloatArray:
        """Diameters, pixels, (N,)."""
        return np.concatenate([part.factor * part.detection.scale for part in self.parts])

    @property
    def response(self) -> FloatArray:
        """Strengths, (N,): contrast times diameter, as of a picture that is taken whole."""
        return np.concatenate([part.factor * part.detection.response for part in self.parts])

    def describe(self, chosen: NDArray[np.intp]) -> Features:
        """Describe the chosen keypoints, part by part."""
        stops = np.cumsum([len(part.detection.points) for part in self.parts])
        found = []
        for part, stop in zip(self.parts, stops, strict=True):
            start = stop - len(part.detection.points)
            found.append(part.describe(chosen[(chosen >= start) & (chosen < stop)] - start))
        return Features.concatenate(found)


def _strips(grey: Grey, options: FeatureOptions) -> Iterator[_Part]:
    """The finest octave, strip by strip."""
    height = len(grey)
    borders = np.linspace(0, height, -(-grey.size // _STRIP_PIXELS) + 1).astype(int)
    for start, stop in zip(borders[:-1].tolist(), borders[1:].tolist(), strict=True):
        top = max(0, start - _OVERLAP)
        found = OpenCVDetection.find(grey[top : min(height, stop + _OVERLAP)], options)
        row = found.points[:, 1] + top
        # Of what two strips see either keeps its own half.
        own = ((row >= start) | (start == 0)) & ((row < stop) | (stop == height))
        yield _Part(found.take(np.flatnonzero(own & _in_octaves(found, _FINEST))), top, 1)


def _in_octaves(found: OpenCVDetection, octaves: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which keypoints are of one of the octaves."""
    return np.array([keypoint.octave & 255 in octaves for keypoint in found.keypoints], dtype=np.bool_)
