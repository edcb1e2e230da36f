"""The result of every minimal solver."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.arrays import FloatArray, Rows
from rdstitch.errors import ArgumentError


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

    def __len__(self) -> int:
        """Number of solutions."""
        return len(self.sample)

    @classmethod
    def empty(cls) -> Self:
        """No solution."""
        return cls(np.empty(0, dtype=np.intp), np.empty((0, 3, 3)), np.empty(0))


def as_samples(x1: ArrayLike, x2: ArrayLike, count: int) -> tuple[FloatArray, FloatArray]:
    """Check samples of ``count`` normalized points of both images, and give a single one its batch axis.

    ArgumentError when a shape is not (B, count, 2) or (count, 2).
    """
    a, b = np.asarray(x1, dtype=np.float64), np.asarray(x2, dtype=np.float64)
    if a.shape != b.shape or a.ndim not in (2, 3) or a.shape[-2:] != (count, 2):
        raise ArgumentError(
            f"expected two arrays of shape (B, {count}, 2) or ({count}, 2), not {a.shape} and {b.shape}"
        )
    return a.reshape(-1, count, 2), b.reshape(-1, count, 2)
