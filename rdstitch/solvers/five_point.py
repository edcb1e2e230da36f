"""Five points, general homography: λ from the direction of the fifth point."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.geometry.division_model import SOLVED_DISTORTION
from rdstitch.solvers.batch import IndexArray, SampleArrays, solve_in_blocks
from rdstitch.solvers.homography import Quadrangles
from rdstitch.solvers.lines import determinants, oriented_samples, squared_radii
from rdstitch.solvers.plane import lens_range
from rdstitch.solvers.roots import real_roots
from rdstitch.solvers.solutions import Solutions

_DEGREE = 4


def five_point(x1: ArrayLike, x2: ArrayLike, distortion_range: tuple[float, float] = SOLVED_DISTORTION) -> Solutions:
    """Any homography, and λ, from five points; needs no focal length.

    For fixed λ four points give the homography (:mod:`rdstitch.solvers.homography`). The third row of the direct linear
    transformation of point 5, ``x̂_5 (H p_5)_y = ŷ_5 (H p_5)_x``, does not contain the lifted coordinate of image 2:

    ``Σ_i β_i α_j α_k γ_i (x̂_5 ŷ_i - ŷ_5 x̂_i) = 0``, ``γ_i = det(p_5, p_j, p_k)``,

    of degree 4 in λ. Distances along the ray of point 5, its second equation, are left to the data.

    Parameters
    ----------
    x1, x2 : array_like of shape (B, 5, 2) or (5, 2)
        Normalized points of image 1 and image 2.
    distortion_range : (float, float)
        Range of λ, in the frame of the points, to search.

    Returns
    -------
    Solutions
        Every real λ in the range for which all points are in front of the camera and within the lens model, and the
        homography does not mirror.
    """

    def solve(points: FloatArray, _: IndexArray) -> Solutions:
        quadrangles = Quadrangles.of(points)
        usable, low, high = oriented_samples(quadrangles.triangles, *lens_range(points, distortion_range))
        quadrangles = quadrangles.take(usable)
        index, distortion = real_roots(DirectionEquation.of(quadrangles), _DEGREE, low, high)
        quadrangles = quadrangles.take(index)
        h, possible = quadrangles.homography(distortion)
        fifth = quadrangles.points[:, 0, 4]
        x, y = fifth
        possible &= h[:, 2, 0] * x + h[:, 2, 1] * y + h[:, 2, 2] * (1.0 + distortion * squared_radii(fifth)) > 0.0
        return Solutions(usable[index[possible]], h[possible], distortion[possible])

    return solve_in_blocks(solve, x1, x2, 5)


@dataclass(frozen=True, eq=False)
class DirectionEquation(SampleArrays):
    """The equation of :func:`five_point`."""

    linear: FloatArray  # (2, 3, 3, b): constant and slope of α_1..3, of β_1..3, and of γ_1..3 with their factors

    @classmethod
    def of(cls, quadrangles: Quadrangles) -> "DirectionEquation":
        """Set up the equation of samples of five points."""
        (x, y), fifth = quadrangles.points[:, 1, :3], quadrangles.points[:, :, 4:]
        across = fifth[0, 1] * y - fifth[1, 1] * x
        gamma = determinants(fifth, quadrangles.opposite)[:, :1]
        return cls(np.concatenate([quadrangles.triangles[:, :, 1:], gamma * across], axis=1))

    def polynomial(self, distortion: FloatArray) -> FloatArray:
        """The equation itself."""
        constant, slope = self.linear[:, :, :, None] if distortion.ndim > 1 else self.linear
        alpha, beta, gamma = constant + slope * distortion
        a1, a2, a3 = alpha
        first, second, third = beta * gamma
        return np.asarray(first * (a2 * a3) + second * (a3 * a1) + third * (a1 * a2))
