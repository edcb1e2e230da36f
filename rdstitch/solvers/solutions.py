"""The result of every minimal solver."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray, Rows


@dataclass(frozen=True, eq=False)
class Solutions(Rows):
    """All solutions of a batch of samples; a sample may have none or several.

    Attributes
    ----------
    sample : ndarray of shape (M,), intp
        Index of the sample that each solution solves, ascending.
    homography : ndarray of shape (M, 3, 3)
        ``p2(λ) ~ H p1(λ)`` with the sign that keeps the sample's points in front of the camera.
    distortion : ndarray of shape (M,)
        λ in the frame of the points.
    focal : ndarray of shape (M,), optional
        Focal length in the unit of the points, from solvers that find it.
    """

    sample: NDArray[np.intp]
    homography: FloatArray
    distortion: FloatArray
    focal: FloatArray | None = None

    @classmethod
    def empty(cls) -> Self:
        """No solution."""
        return cls(np.empty(0, dtype=np.intp), np.empty((0, 3, 3)), np.empty(0))
