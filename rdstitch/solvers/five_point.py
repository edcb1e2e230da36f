"""Five points, general homography: λ from the direction of the fifth point."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.camera import FloatArray
from rdstitch.solvers.batch import SampleArrays, solve_in_blocks
from rdstitch.solvers.homography import homography_through
from rdstitch.solvers.orientation import determinants, oriented_samples, triangle_determinants
from rdstitch.solvers.plane import lens_range
from rdstitch.solvers.roots import real_roots
from rdstitch.solvers.solutions import Solutions

_DEGREE = 4


def five_point(x1: ArrayLike, x2: ArrayLike, distortion_range: tuple[float, float] = (-1.5, 0.5)) -> Solutions:
    """Any homography, and λ, from five points; needs no focal length.

    For fixed λ four points give the homography (:mod:`rdstitch.solvers.homography`). The third row of the direct linear
    transformation of point 5, ``x̂_5 (H p_5)_y = ŷ_5 (H p_5)_x``, does not contain the lifted coordinate of picture 2:

    ``Σ_i β_i α_j α_k γ_i (x̂_5 ŷ_i - ŷ_5 x̂_i) = 0``, ``γ_i = det(p_5, p_j, p_k)``,

    of degree 4 in λ. Distances along the ray of point 5, its second equation, are left to the data.

    Parameters
    ----------
    x1, x2 : array_like of shape (B, 5, 2) or (5, 2)
        Normalized points of picture 1 and picture 2.
    distortion_range : (float, float)
        Range of λ, in the frame of the points, to search.

    Returns
    -------
    Solutions
        Every real λ in the range for which all points are in front of the camera and within the lens model, and the
        homography does not mirror.

    Raises
    ------
    ArgumentError
        When a shape is wrong or the range is empty.
    """

    def solve(a: FloatArray, b: FloatArray, _: NDArray[np.intp]) -> Solutions:
        usable, low, high = oriented_samples(a, b, *lens_range(a, b, distortion_range))
        a, b = np.take(a, usable, axis=-1), np.take(b, usable, axis=-1)
        index, distortion = real_roots(DirectionEquation.from_points(a, b), _DEGREE, low, high)
        a, b = np.take(a, index, axis=-1), np.take(b, index, axis=-1)
        h, possible = homography_through(a, b, distortion)
        x, y = a[4]
        depth = h[:, 2, 0] * x + h[:, 2, 1] * y + h[:, 2, 2] * (1.0 + distortion * (x**2 + y**2))
        possible &= depth > 0.0
        return Solutions(usable[index[possible]], h[possible], distortion[possible])

    return solve_in_blocks(solve, x1, x2, 5)


class DirectionEquation(SampleArrays):
    """The equation of :func:`five_point`; rows: α_1..3, β_1..3, γ_1..3 with their factors."""

    @classmethod
    def from_points(cls, x1: FloatArray, x2: FloatArray) -> "DirectionEquation":
        """From points of shape (5, 2, B)."""
        alpha, beta = triangle_determinants(x1)[:, 1:], triangle_determinants(x2)[:, 1:]
        a, b, c, _, fifth = x1
        gamma = np.stack([determinants(fifth, b, c), determinants(a, fifth, c), determinants(a, b, fifth)], axis=1)
        across = x2[4, 0] * x2[:3, 1] - x2[4, 1] * x2[:3, 0]
        return cls(np.concatenate([alpha, beta, gamma * across], axis=1))

    def polynomial(self, distortion: FloatArray) -> FloatArray:
        """The equation itself."""
        constant, slope = self.rows[:, :, None] if distortion.ndim > 1 else self.rows
        a1, a2, a3, b1, b2, b3, g1, g2, g3 = constant + slope * distortion
        value: FloatArray = b1 * a2 * a3 * g1 + b2 * a3 * a1 * g2 + b3 * a1 * a2 * g3
        return value
