"""Two points, known tilt: λ from the one distance between them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.geometry.division_model import SOLVED_DISTORTION
from rdstitch.solvers.batch import IndexArray, SampleArrays, sample_count, solve_in_blocks
from rdstitch.solvers.lines import Lines
from rdstitch.solvers.plane import TiltRotations, depths, differences, motion_homography, visible_range
from rdstitch.solvers.roots import real_roots
from rdstitch.solvers.solutions import Solutions

_DEGREE = 6


def two_point(
    x1: ArrayLike,
    x2: ArrayLike,
    tilt: ArrayLike = (0.0, 0.0),
    distortion_range: tuple[float, float] = SOLVED_DISTORTION,
) -> Solutions:
    """Planar motion and λ from two points, for known tilt (Valtonen Örnhag et al., §4.2, extended to any tilt).

    A motion in the plane keeps the distance of the two points. With ``X_1 - X_2 = m / (w_1 w_2)``, whose numerator
    m and depths w are linear in λ (see :mod:`rdstitch.solvers.plane`), that is

    ``|m|² (ŵ_1 ŵ_2)² = |m̂|² (w_1 w_2)²``,

    of degree 6 in λ. The rigid motion of the two plane points gives the rest.

    Parameters
    ----------
    x1, x2 : array_like of shape (B, 2, 2) or (2, 2)
        Focal-normalized points of image 1 and image 2.
    tilt : array_like of shape (2,), (2, 2) or (B, 2, 2)
        (ψ, θ) of the camera, radians; or one such pair an image; or one a sample and image.
    distortion_range : (float, float)
        Range of λ (focal-normalized) to search.

    Returns
    -------
    Solutions
        Every real λ in the range for which all points are in front of the camera and within the lens model.
    """
    rotations = TiltRotations.from_tilt(tilt, sample_count(x1))

    def solve(points: FloatArray, samples: IndexArray) -> Solutions:
        tilts = rotations.take(samples)
        depth = depths(points, tilts)
        between = Lines.through(points[:, :, :1], points[:, :, 1:])
        equation = DistanceEquation.of(differences(between, tilts), depth)
        index, distortion = real_roots(equation, _DEGREE, *visible_range(points, depth, distortion_range))
        homography = motion_homography(np.take(points, index, axis=-1), tilts.take(index), distortion)
        return Solutions(index, homography, distortion)

    return solve_in_blocks(solve, x1, x2, 2)


@dataclass(frozen=True, eq=False)
class DistanceEquation(SampleArrays):
    """``|m|² (ŵ_1 ŵ_2)² - |m̂|² (w_1 w_2)² = 0``."""

    linear: FloatArray  # (2, 4, 2, b): constants and slopes; m_x, m_y, w_1, w_2; image, sample

    @classmethod
    def of(cls, difference: FloatArray, depth: FloatArray) -> "DistanceEquation":
        """The equation of :func:`rdstitch.solvers.plane.differences` and :func:`rdstitch.solvers.plane.depths`."""
        return cls(np.concatenate([difference[:, :, :, 0], depth.swapaxes(1, 2)], axis=1))

    def polynomial(self, distortion: FloatArray) -> FloatArray:
        """The equation itself."""
        constant, slope = self.linear[:, :, :, None] if distortion.ndim > 1 else self.linear
        mx, my, w1, w2 = constant + slope * distortion
        length, (w, v) = mx * mx + my * my, w1 * w2
        return np.asarray(length[0] * (v * v) - length[1] * (w * w))
