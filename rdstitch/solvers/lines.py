"""Lines through pairs of lifted points, and determinants of three: what all equations in λ are made of.

Inside a solver the points of both images have shape (2, 2, k, b): coordinate, image, point, sample.

Two coordinates of a lifted point ``p(λ) = (x, y, 1 + λ r²)`` do not depend on λ. So the line ``p_j × p_k`` is linear in
λ, its third coordinate constant; ``p_i · (p_j × p_k) = det(p_i, p_j, p_k)`` is linear in λ too.

In front of the camera such a determinant has the sign of the triangle's orientation in the plane, whatever the tilt. A
camera that stays on its side of the plane never mirrors a triangle: the determinants of both images have the same sign,
which tells most impossible samples from possible ones before anything is solved.
"""

from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.solvers.batch import IndexArray, SampleArrays

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
    return np.asarray(x * x + y * y)


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


def oriented_samples(
    triangles: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[IndexArray, FloatArray, FloatArray]:
    """Samples (M,) whose triangles can have equal orientations in both images, and the ranges of λ for that.

    Of ranges (b,), empty where ``low < high`` does not hold, and :func:`triangle_determinants` (2, 2, T, b). Between
    the zeros of the determinants no sign changes, so that the middle of each piece tells for all of it; a range goes
    from the first to the last piece where all orientations agree.
    """
    batch = len(low)
    constant, slope = triangles.reshape(2, -1, batch)
    count = len(constant)
    edges = np.empty((count + 2, batch))
    edges[0], edges[-1] = low, high
    zeros = edges[1:-1]
    np.divide(constant, slope, out=zeros)
    np.negative(zeros, out=zeros)
    # Of a determinant that does not depend on λ: infinite, or if it is zero NaN.
    np.fmin(np.fmax(zeros, low, out=zeros), high, out=zeros)
    zeros.sort(axis=0)
    middle = 0.5 * (edges[1:] + edges[:-1])
    positive = constant[:, None] + slope[:, None] * middle > 0.0
    kept = (positive[: count // 2] == positive[count // 2 :]).all(axis=0)
    kept &= edges[1:] > edges[:-1]
    sample = np.flatnonzero(kept.any(axis=0))
    kept, edges = kept[:, sample], edges[:, sample]
    return (sample, np.where(kept, edges[:-1], np.inf).min(axis=0), np.where(kept, edges[1:], -np.inf).max(axis=0))


def mirrored(triangles: FloatArray, distortion: FloatArray) -> BoolArray:
    """Test for triangles of opposite orientations, for one λ a sample (M,); shape (M,)."""
    constant, slope = triangles
    first, second = constant + slope * distortion
    return np.asarray((first * second < 0.0).any(axis=0))
