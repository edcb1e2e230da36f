"""Features as they are stored: descriptors in a quarter or half of their size, which matching cannot tell apart."""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.features.keypoints import Descriptors, Features

_MAX_HALF = 60000.0  # half precision ends a little above


@dataclass(frozen=True, eq=False)
class PackedFeatures:
    """Features of one picture.

    Attributes
    ----------
    features : Features
        Their descriptors are replaced by none.
    descriptors : ndarray of shape (N, D), uint8, float16 or float32
        Bits; integers up to 255 such as SIFT's and, but for rare ones, RootSIFT's, which lose nothing; else half
        precision, which is finer than the grid of 1/512 of the largest norm on which descriptors are compared.
    bits : bool
        Whether descriptors are bits.
    """

    features: Features
    descriptors: NDArray[Any]
    bits: bool

    @classmethod
    def pack(cls, features: Features) -> Self:
        """Pack the features of a picture."""
        bare = replace(features, descriptors=np.zeros((len(features), 0), dtype=features.descriptors.dtype))
        return cls(bare, _smallest(features.descriptors), features.binary)

    def unpack(self) -> Features:
        """The features, with descriptors that can be compared."""
        descriptors: Descriptors = self.descriptors if self.bits else self.descriptors.astype(np.float32)
        return replace(self.features, descriptors=descriptors)


def _smallest(descriptors: Descriptors) -> NDArray[Any]:
    """Descriptors in the smallest type that holds them."""
    if descriptors.dtype == np.uint8:
        return descriptors
    if not len(descriptors):
        return descriptors.astype(np.float16)
    if descriptors.min() >= 0.0 and descriptors.max() <= 255.0:
        integers = descriptors.astype(np.uint8)
        if np.array_equal(integers, descriptors):
            return integers
    half = np.abs(descriptors).max() <= _MAX_HALF
    return descriptors.astype(np.float16 if half else np.float32)
