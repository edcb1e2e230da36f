"""Three points, known tilt, free height: λ from the ratio of two distances."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.geometry.division_model import SOLVED_DISTORTION
from rdstitch.solvers.batch import IndexArray, SampleArrays, sample_count, solve_in_blocks
from rdstitch.solvers.lines import Lines, mirrored, oriented_samples, triangle_determinants
from rdstitch.solvers.plane import TiltRotations, depths, differences, motion_homography, visible_range
from rdstitch.solvers.roots import real_roots
from rdstitch.solvers.solutions import Solutions

_DEGREE = 8


def three_point_similarity(
    x1: ArrayLike,
    x2: ArrayLike,
    tilt: ArrayLike = (0.0, 0.0),
    distortion_range: tuple[float, float] = SOLVED_DISTORTION,
) -> Solutions:
    """Planar motion with a change of height, and λ, from three points, for known tilt.

    A similarity keeps ratios of distances. With ``X_i - X_j = m_ij / (w_i w_j)``, whose numerators and depths are
    linear in λ (see :mod:`rdstitch.solvers.plane`), ``|d_12|² |d̂_13|² = |d̂_12|² |d_13|²`` is

    ``|m_12|² |m̂_13|² (w_3 ŵ_2)² = |m̂_12|² |m_13|² (ŵ_3 w_2)²``,

    of degree 8 in λ. The least-squares similarity of the three plane points gives the rest. The second ratio of the
    same three points is not used to pick among the roots: under noise the other data do that better.

    Parameters
    ----------
    x1, x2 : array_like of shape (B, 3, 2) or (3, 2)
        Focal-normalized points of image 1 and image 2.
    tilt : array_like of shape (2,), (2, 2) or (B, 2, 2)
        (ψ, θ) of the camera, radians; or one such pair an image; or one a sample and image.
    distortion_range : (float, float)
        Range of λ (focal-normalized) to search.

    Returns
    -------
    Solutions
        Every real λ in the range for which all points are in front of the camera and within the lens model and the
        triangle is not mirrored.
    """
    rotations = TiltRotations.from_tilt(tilt, sample_count(x1))

    def solve(points: FloatArray, samples: IndexArray) -> Solutions:
        tilts = rotations.take(samples)
        opposite, depth = Lines.opposite(points), depths(points, tilts)
        triangles = triangle_determinants(points, opposite)
        usable, low, high = oriented_samples(triangles, *visible_range(points, depth, distortion_range))
        tilts = tilts.take(usable)
        equation = DistanceRatioEquation.of(differences(opposite.take(usable), tilts), np.take(depth, usable, axis=-1))
        index, distortion = real_roots(equation, _DEGREE, low, high)
        tilts, index = tilts.take(index), usable[index]
        h = motion_homography(np.take(points, index, axis=-1), tilts, distortion, height_free=True)
        possible = ~mirrored(np.take(triangles, index, axis=-1), distortion)
        return Solutions(index[possible], h[possible], distortion[possible])

    return solve_in_blocks(solve, x1, x2, 3)


@dataclass(frozen=True, eq=False)
class DistanceRatioEquation(SampleArrays):
    """The equation of :func:`three_point_similarity`."""

    # (2, 6, 2, b): constants and slopes; the x of m_13 and m_12, their y, then w_2 and w_3; image, sample
    linear: FloatArray

    @classmethod
    def of(cls, difference: FloatArray, depth: FloatArray) -> "DistanceRatioEquation":
        """Take :func:`rdstitch.solvers.plane.differences` and :func:`rdstitch.solvers.plane.depths` of triangles."""
        x, y = difference[:, 0, :, 1:], difference[:, 1, :, 1:]
        return cls(np.concatenate([x, y, depth[:, :, 1:]], axis=2).swapaxes(1, 2))

    def polynomial(self, distortion: FloatArray) -> FloatArray:
        """The equation itself."""
        constant, slope = self.linear[:, :, :, None] if distortion.ndim > 1 else self.linear
        linear = constant + slope * distortion
        x, y = linear[:2], linear[2:4]
        m13, m12 = x * x + y * y
        w2, w3 = linear[4:]
        w, v = w3[0] * w2[1], w3[1] * w2[0]
        return np.asarray(m12[0] * m13[1] * (w * w) - m12[1] * m13[0] * (v * v))
