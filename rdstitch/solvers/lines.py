"""Lines through pairs of lifted points, and determinants of three: what all equations in λ are made of.

Inside a solver the points of both images have shape (2, 2, k, b): coordinate, image, point, sample.

Two coordinates of a lifted point ``p(λ) = (x, y, 1 + λ r²)`` do not depend on λ. So the line ``p_j × p_k`` is linear in
λ, its third coordinate constant; ``p_i · (p_j × p_k) = det(p_i, p_j, p_k)`` is linear in λ too.
"""

from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.solvers.batch import SampleArrays

_RING = [1, 2, 0, 1]


@dataclass(frozen=True, eq=False)
class Lines(SampleArrays):
    """Lines in both images."""

    constant: FloatArray  # (3, 2, L, b): coordinate, image, line, sample
    slope: FloatArray  # (2, 2, L, b): derivative by λ of the first two coordinates

    @classmethod
    def through(cls, first: FloatArray, second: FloatArray) -> "Lines":
        """``p × q`` of points (2, 2, L, b) each."""
        (xp, yp), (xq, yq) = first, second
        rp, rq = squared_radii(first), squared_radii(second)
        dx, dy = xp - xq, yp - yq
        return cls(np.stack([dy, -dx, yq * dx - xq * dy]), np.stack([yp * rq - yq * rp, rp * xq - rq * xp]))

    @classmethod
    def opposite(cls, points: FloatArray) -> "Lines":
        """Join the first three points: the line ``p_j × p_k`` opposite to each, in cyclic order."""
        ring = np.take(points, _RING, axis=2)
        return cls.through(ring[:, :, :3], ring[:, :, 1:])

    def at(self, distortion: FloatArray) -> FloatArray:
        """The lines for one λ a sample (b,), shape (3, 2, L, b)."""
        lines = self.constant.copy()
        lines[:2] += self.slope * distortion
        return lines


def squared_radii(points: FloatArray) -> FloatArray:
    """``x² + y²`` of points (2, ...)."""
    x, y = points
    radii: FloatArray = x * x + y * y
    return radii


def determinants(points: FloatArray, lines: Lines) -> FloatArray:
    """Constant and slope in λ of ``p · l`` for points (2, 2, L, b), or one for all lines; shape (2, 2, L, b)."""
    x, y = points
    c1, c2, c3 = lines.constant
    s1, s2 = lines.slope
    return np.stack([x * c1 + y * c2 + c3, x * s1 + y * s2 + squared_radii(points) * c3])


def triangle_determinants(points: FloatArray, opposite: Lines) -> FloatArray:
    """Determinants of the triangles of the first three or four points (2, 2, k, b), shape (2, 2, 1 or 4, b).

    First ``det(p_1, p_2, p_3)``; with four points then the same with point 1, 2 and 3 replaced by point 4. ``opposite``
    comes from :meth:`Lines.opposite`.
    """
    first_side = Lines(opposite.constant[:, :, :1], opposite.slope[:, :, :1])
    whole = determinants(points[:, :, :1], first_side)
    if points.shape[2] == 3:
        return whole
    return np.concatenate([whole, determinants(points[:, :, 3:4], opposite)], axis=2)
