"""Results of detection and matching: keypoints and descriptors of an image, and corresponding points of two."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray, Rows
from rdstitch.errors import ArgumentError

Descriptors = NDArray[np.float32] | NDArray[np.uint8]


_OF_A_KEYPOINT = ("scale", "angle", "response", "laplacian_sign")  # numbers, beside its place and descriptor
_MAX_HALF = 60000.0  # half precision ends a little above


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints of one image with their descriptors, the strongest first."""

    # (N, 2), float64: keypoints ``(u, v)``, pixels of the full-size image, whatever size they were detected at
    points: FloatArray
    # (N, D): float32 numbers, compared by their Euclidean distance; or uint8, eight bits to a byte, compared by the
    # Hamming distance
    descriptors: Descriptors
    scale: FloatArray  # (N,), float64: diameter of the keypoint (OpenCV's ``size``), pixels of the full-size image
    angle: FloatArray  # (N,), float64: orientation, radians in [0, 2π), from u towards v; 0 where the kind has none
    response: FloatArray  # (N,), float64: strength, in units of the detector
    # (N,), int8: +1 for dark blobs on light ground, -1 for light ones on dark; only equal signs match. None where the
    # kind has no such sign
    laplacian_sign: NDArray[np.int8] | None
    kind: str  # what detected and described them; features of different kinds cannot be compared
    image_size: tuple[int, int] | None = None  # width and height of the image, pixels
    # keypoints that the image shows at its working size, before any were chosen, or a larger image was used for want of
    # them; None where that is not known
    detected_count: int | None = None
    # whether these are few, and most of them only just strong enough: they are not seen at the contrast divided by what
    # equalizing it locally multiplies it by at most
    low_contrast: bool = False

    def __post_init__(self) -> None:
        count = len(self.points)
        if self.points.shape != (count, 2) or not np.isfinite(self.points).all():
            raise ArgumentError(f"points must be finite and of shape (N, 2), not {self.points.shape}")
        if self.descriptors.ndim != 2 or len(self.descriptors) != count:
            raise ArgumentError(f"{count} points, but descriptors of shape {self.descriptors.shape}")
        if self.descriptors.dtype not in (np.float32, np.uint8):
            raise ArgumentError(f"descriptors must be float32 or uint8, not {self.descriptors.dtype}")
        for name in _OF_A_KEYPOINT:
            if (values := getattr(self, name)) is not None and values.shape != (count,):
                raise ArgumentError(f"{count} points, but {name} of shape {values.shape}")

    def __len__(self) -> int:
        return len(self.points)

    def take(self, index: NDArray[np.intp]) -> Self:
        """The keypoints of the given indices, in their order."""
        columns = {name: getattr(self, name) for name in ("points", "descriptors", *_OF_A_KEYPOINT)}
        taken: dict[str, Any] = {name: values[index] for name, values in columns.items() if values is not None}
        return replace(self, **taken)

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """All keypoints of at least one part; parts are of one kind, with signs of the Laplacian."""
        names = ("points", "descriptors", *_OF_A_KEYPOINT)
        joined: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return replace(parts[0], **joined)

    @property
    def binary(self) -> bool:
        """True for descriptors of bits, compared by the Hamming distance."""
        return self.descriptors.dtype == np.uint8


@dataclass(frozen=True, eq=False)
class Detection:
    """Keypoints of one image, not yet described; always in the same order for the same image."""

    points: FloatArray  # (N, 2): places, pixels of the image
    scale: FloatArray  # (N,): diameters, pixels
    response: FloatArray  # (N,): strengths, in units of the detector
    # features of the keypoints of some indices, in an order of the detector's own, and without those it cannot describe
    describe: Callable[[NDArray[np.intp]], Features]

    def take(self, index: NDArray[np.intp]) -> "Detection":
        """The keypoints of the given indices, in their order."""
        points, scale, response = self.points[index], self.scale[index], self.response[index]
        return Detection(points, scale, response, lambda chosen: self.describe(index[chosen]))


@dataclass(frozen=True, eq=False)
class PackedFeatures:
    """Features as they are stored: descriptors in a quarter or half of their size, which matching cannot tell apart."""

    features: Features  # their descriptors are replaced by none, of the same type
    # (N, D). uint8: bits, or integers up to 255, such as SIFT's and nearly all of RootSIFT's; else float16, which is
    # finer than the grid of 1/512 of the largest norm on which descriptors are compared; float32 beyond its range
    descriptors: NDArray[Any]

    @classmethod
    def pack(cls, features: Features) -> Self:
        """Pack the features of an image."""
        bare = replace(features, descriptors=np.zeros((len(features), 0), dtype=features.descriptors.dtype))
        return cls(bare, _smallest(features.descriptors))

    def take(self, index: NDArray[np.intp]) -> Self:
        """The features of the given indices, in their order."""
        return replace(self, features=self.features.take(index), descriptors=self.descriptors[index])

    def unpack(self) -> Features:
        """The features, with descriptors that can be compared."""
        binary = self.features.binary
        descriptors: Descriptors = self.descriptors if binary else self.descriptors.astype(np.float32)
        return replace(self.features, descriptors=descriptors)


def _smallest(descriptors: Descriptors) -> NDArray[Any]:
    """Descriptors in the smallest type that holds them."""
    integers: NDArray[np.uint8] = np.clip(np.nan_to_num(descriptors), 0, 255).astype(np.uint8)
    if np.array_equal(integers, descriptors):
        return integers
    return descriptors.astype(np.float16 if np.abs(descriptors).max() <= _MAX_HALF else np.float32)


@dataclass(frozen=True, eq=False)
class Correspondences(Rows):
    """Points of two images that show the same, the most distinctive match first (PROSAC's order)."""

    indices: NDArray[np.intp]  # (M, 2), intp: indices into the features of image 1 and image 2
    points1: FloatArray  # points1, points2: (M, 2), float64: pixels of the full-size images
    points2: FloatArray
    # (M,), float64: distance to the match over distance to the second-best, the worse of both directions; in [0, 1],
    # ascending
    ratio: FloatArray

    def __post_init__(self) -> None:
        count = len(self.ratio)
        shapes = (self.indices.shape, self.points1.shape, self.points2.shape, self.ratio.shape)
        if shapes != ((count, 2), (count, 2), (count, 2), (count,)):
            raise ArgumentError(f"correspondences of different lengths: {shapes}")

    @classmethod
    def of(cls, features1: Features, features2: Features, indices: NDArray[np.intp], ratio: FloatArray) -> Self:
        """Correspondences between the features of two images."""
        return cls(indices, features1.points[indices[:, 0]], features2.points[indices[:, 1]], ratio)
