"""Two points, known tilt: λ from the one distance between them."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.camera import FloatArray
from rdstitch.solvers.batch import SampleArrays, solve_in_blocks
from rdstitch.solvers.plane import TiltRotations, depths, differences, motion_homography, visible_range
from rdstitch.solvers.roots import real_roots
from rdstitch.solvers.solutions import Solutions

_DEGREE = 6


def two_point(
    x1: ArrayLike,
    x2: ArrayLike,
    tilt: ArrayLike = (0.0, 0.0),
    distortion_range: tuple[float, float] = (-1.5, 0.5),
) -> Solutions:
    """Planar motion and λ from two points, for known tilt (Valtonen Örnhag et al., §4.2, extended to any tilt).

    A motion in the plane keeps the distance of the two points. With ``X_1 - X_2 = m / (w_1 w_2)``, whose numerator
    m and depths w are linear in λ (see :mod:`rdstitch.solvers.plane`), that is

    ``|m|² (ŵ_1 ŵ_2)² = |m̂|² (w_1 w_2)²``,

    of degree 6 in λ. The rigid motion of the two plane points gives the rest.

    Parameters
    ----------
    x1, x2 : array_like of shape (B, 2, 2) or (2, 2)
        Focal-normalized points of picture 1 and picture 2.
    tilt : array_like of shape (2,), (2, 2) or (B, 2, 2)
        (ψ, θ) of the camera, radians; or one such pair a picture; or one a sample and picture.
    distortion_range : (float, float)
        Range of λ (focal-normalized) to search.

    Returns
    -------
    Solutions
        Every real λ in the range for which all points are in front of the camera and within the lens model.

    Raises
    ------
    ArgumentError
        When a shape is wrong or the range is empty.
    """
    rotations = TiltRotations.from_tilt(tilt, np.shape(x1)[0] if np.ndim(x1) else 0)

    def solve(a: FloatArray, b: FloatArray, samples: NDArray[np.intp]) -> Solutions:
        own = rotations.take(samples)
        equation = DistanceEquation.from_points(a, b, own)
        index, distortion = real_roots(equation, _DEGREE, *visible_range(a, b, own, distortion_range))
        a, b = np.take(a, index, axis=-1), np.take(b, index, axis=-1)
        return Solutions(index, motion_homography(a, b, own.take(index), distortion), distortion)

    return solve_in_blocks(solve, x1, x2, 2)


class DistanceEquation(SampleArrays):
    """``|m|² (ŵ_1 ŵ_2)² - |m̂|² (w_1 w_2)² = 0``; rows: for each picture m_x, m_y, w_1, w_2, constants then slopes."""

    @classmethod
    def from_points(cls, x1: FloatArray, x2: FloatArray, rotations: TiltRotations) -> "DistanceEquation":
        """From points of shape (2, 2, B)."""
        pictures = ((x1, rotations.first), (x2, rotations.second))
        rows = [np.concatenate([differences(x, r, ((0, 1),))[:, :, 0], depths(x, r)], axis=1) for x, r in pictures]
        return cls(np.stack(rows, axis=1))

    def _factors(self, distortion: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        constant, slope = self.rows[:, :, :, None] if distortion.ndim > 1 else self.rows
        (mx, my, w1, w2), (ox, oy, v1, v2) = constant + slope * distortion
        return mx**2 + my**2, w1 * w2, ox**2 + oy**2, v1 * v2

    def polynomial(self, distortion: FloatArray) -> FloatArray:
        """The equation itself."""
        m2, w, o2, v = self._factors(distortion)
        return m2 * v**2 - o2 * w**2
