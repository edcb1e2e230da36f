"""Three points, known tilt, free height: λ from the ratio of two distances."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.camera import FloatArray
from rdstitch.solvers.batch import SampleArrays, solve_in_blocks
from rdstitch.solvers.orientation import mirrored, oriented_samples
from rdstitch.solvers.plane import TiltRotations, depths, differences, motion_homography, visible_range
from rdstitch.solvers.roots import real_roots
from rdstitch.solvers.solutions import Solutions

_DEGREE = 8


def three_point_similarity(
    x1: ArrayLike,
    x2: ArrayLike,
    tilt: ArrayLike = (0.0, 0.0),
    distortion_range: tuple[float, float] = (-1.5, 0.5),
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
        Focal-normalized points of picture 1 and picture 2.
    tilt : array_like of shape (2,), (2, 2) or (B, 2, 2)
        (ψ, θ) of the camera, radians; or one such pair a picture; or one a sample and picture.
    distortion_range : (float, float)
        Range of λ (focal-normalized) to search.

    Returns
    -------
    Solutions
        Every real λ in the range for which all points are in front of the camera and within the lens model and the
        triangle is not mirrored.

    Raises
    ------
    ArgumentError
        When a shape is wrong or the range is empty.
    """
    rotations = TiltRotations.from_tilt(tilt, np.shape(x1)[0] if np.ndim(x1) else 0)

    def solve(a: FloatArray, b: FloatArray, samples: NDArray[np.intp]) -> Solutions:
        own = rotations.take(samples)
        usable, low, high = oriented_samples(a, b, *visible_range(a, b, own, distortion_range))
        a, b, own = np.take(a, usable, axis=-1), np.take(b, usable, axis=-1), own.take(usable)
        index, distortion = real_roots(DistanceRatioEquation.from_points(a, b, own), _DEGREE, low, high)
        a, b, own = np.take(a, index, axis=-1), np.take(b, index, axis=-1), own.take(index)
        h = motion_homography(a, b, own, distortion, height_free=True)
        possible = ~mirrored(a, b, distortion)
        return Solutions(usable[index[possible]], h[possible], distortion[possible])

    return solve_in_blocks(solve, x1, x2, 3)


class DistanceRatioEquation(SampleArrays):
    """The equation of :func:`three_point_similarity`.

    Rows: for each picture the x of m_12 and m_13, their y, then w_2 and w_3; constants, then slopes.
    """

    @classmethod
    def from_points(cls, x1: FloatArray, x2: FloatArray, rotations: TiltRotations) -> "DistanceRatioEquation":
        """From points of shape (3, 2, B)."""
        rows = []
        for x, rotation in ((x1, rotations.first), (x2, rotations.second)):
            m = differences(x, rotation, ((0, 1), (0, 2)))
            rows.append(np.concatenate([m[:, 0], m[:, 1], depths(x, rotation)[:, 1:]], axis=1))
        return cls(np.stack(rows, axis=1))

    def _sides(self, distortion: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """``|m_12|² |m̂_13|²`` and ``w_3 ŵ_2``, then the same with the pictures exchanged."""
        constant, slope = self.rows[:, :, :, None] if distortion.ndim > 1 else self.rows
        (ax, bx, ay, by, w2, w3), (cx, dx, cy, dy, v2, v3) = constant + slope * distortion
        return (
            (ax**2 + ay**2) * (dx**2 + dy**2),
            w3 * v2,
            (bx**2 + by**2) * (cx**2 + cy**2),
            w2 * v3,
        )

    def polynomial(self, distortion: FloatArray) -> FloatArray:
        """The equation itself."""
        m2, w, o2, v = self._sides(distortion)
        return m2 * w**2 - o2 * v**2
