"""What matching hands on: points of two pictures that show the same."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.features.keypoints import Features


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Points of two pictures that show the same, the most distinctive match first (PROSAC's order).

    Attributes
    ----------
    indices : ndarray of shape (M, 2), intp
        Indices into the features of picture 1 and picture 2.
    points1, points2 : ndarray of shape (M, 2), float64
        pixels of the full-size pictures.
    ratio : ndarray of shape (M,), float64
        Distance to the match over distance to the second-best, the worse of both directions; in [0, 1],
        ascending.

    Raises
    ------
    ArgumentError
        When the shapes do not fit together.
    """

    indices: NDArray[np.intp]
    points1: FloatArray
    points2: FloatArray
    ratio: FloatArray

    def __post_init__(self) -> None:
        """Check shapes."""
        count = len(self.ratio)
        shapes = (self.indices.shape, self.points1.shape, self.points2.shape, self.ratio.shape)
        if shapes != ((count, 2), (count, 2), (count, 2), (count,)):
            raise ArgumentError(f"correspondences of different lengths: {shapes}")

    @classmethod
    def of(cls, features1: Features, features2: Features, indices: NDArray[np.intp], ratio: FloatArray) -> Self:
        """Correspondences between the features of two pictures."""
        return cls(indices, features1.points[indices[:, 0]], features2.points[indices[:, 1]], ratio)

    def take(self, index: NDArray[np.intp]) -> Self:
        """The correspondences at the given positions."""
        return type(self)(self.indices[index], self.points1[index], self.points2[index], self.ratio[index])

    def __len__(self) -> int:
        """Number of correspondences."""
        return len(self.ratio)
