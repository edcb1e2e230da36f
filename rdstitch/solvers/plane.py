"""The plane as cameras of known tilt see it: plane coordinates, distances, and motions in the plane.

Inside a solver the points of both images have shape (2, 2, k, b): coordinate, image, point, sample. With the tilt's
rotation R and the plane normal ``n = R e3``, a lifted point ``p(λ) = (x, y, 1 + λ r²)`` has the plane coordinates
``X = (R' p)_xy / (n · p)``. The vector between two points of the plane is
``X_i - X_j = J (R' (p_i × p_j))_xy / ((n · p_i)(n · p_j))``, J a quarter turn: both its numerator and the depths
``n · p`` are linear in λ.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.planar_motion import rotation_from_tilt
from rdstitch.solvers.batch import IndexArray, SampleArrays
from rdstitch.solvers.lines import Lines, squared_radii

# Depths and lens factors below this count as at the horizon or at the fold of the lens.
_MIN_DEPTH = 1e-9
# Points nearer than this, relative to their distance from the centre, count as coincident.
_MIN_SEPARATION = 1e-9


@dataclass(frozen=True, eq=False)
class TiltRotations(SampleArrays):
    """Rotations of the two images' tilts."""

    matrices: FloatArray  # (3, 3, 2, 1, 1), or: row, column, image, any point, sample

    @classmethod
    def from_tilt(cls, tilt: ArrayLike, count: int) -> Self:
        """Rotations of one tilt (2,), one an image (2, 2), or one a sample and image (B, 2, 2).

        ArgumentError when the shape is another, a value is not finite, or the camera does not look at the plane.
        """
        angles = np.asarray(tilt, dtype=np.float64)
        if angles.shape not in ((2,), (2, 2), (count, 2, 2)):
            raise ArgumentError(f"tilt must be (psi, theta) or one such pair an image, not of shape {angles.shape}")
        if not (np.abs(angles) < np.pi / 2).all():
            raise ArgumentError("tilt must be below a right angle")
        both = np.broadcast_to(angles, (*angles.shape[:-2], 2, 2)).reshape(-1, 2, 1, 2)
        return cls(np.ascontiguousarray(rotation_from_tilt(both).transpose(3, 4, 1, 2, 0)))

    @classmethod
    def from_normal(cls, normal: FloatArray) -> Self:
        """The smallest rotations that turn e3 to normals (3, b) of length 1, the same for both images."""
        x, y, z = normal
        first, second = x / (1.0 + z), y / (1.0 + z)
        rows = [[1.0 - first * x, -first * y, x], [-second * x, 1.0 - second * y, y], [-x, -y, z]]
        matrices = np.array(rows)[:, :, None, None]
        return cls(np.repeat(matrices, 2, axis=2))

    def take(self, samples: IndexArray) -> Self:
        """The rotations of some samples; indices may repeat."""
        return self if self.matrices.shape[-1] == 1 else super().take(samples)


def depths(points: FloatArray, rotations: TiltRotations) -> FloatArray:
    """Depths ``n · p(λ)`` of points (2, 2, k, b): constant and slope, shape (2, 2, k, b)."""
    x, y = points
    nx, ny, nz = rotations.matrices[:, 2]
    return np.stack([nx * x + ny * y + nz, nz * squared_radii(points)])


def differences(lines: Lines, rotations: TiltRotations) -> FloatArray:
    """``(R' (p_i × p_j))_xy`` of lines: the numerator of ``X_i - X_j`` after a quarter turn, (2, 2, 2, L, b).

    The axes are constant and slope in λ, coordinate, image, line, sample.
    """
    turn = rotations.matrices[:, :2]
    (c1, c2, c3), (s1, s2) = lines.constant, lines.slope
    return np.stack([turn[0] * c1 + turn[1] * c2 + turn[2] * c3, turn[0] * s1 + turn[1] * s2])


def visible_range(
    points: FloatArray, depth: FloatArray, distortion_range: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """The λ for which all points lie within the lens model and in front of the camera, and no two coincide.

    Of points and their :func:`depths` (2, 2, k, b). Within the lens model ``|λ| r² < 1``, and each depth is linear in
    λ, so that it leaves a half-line. Of a degenerate sample the range (b,) is empty, ``low > high``.
    """
    low, high = lens_range(points, distortion_range)
    constant, slope = depth
    # No slope is negative. At the centre it is 0, and the bound as infinite as it should be.
    return np.maximum(low, ((_MIN_DEPTH - constant) / slope).max(axis=(0, 1))), high


def lens_range(points: FloatArray, distortion_range: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """The λ for which all points lie within the lens model, none if two points coincide; see :func:`visible_range`."""
    low, high = distortion_range
    if not low < high:
        raise ArgumentError(f"distortion range must be (low, high) with low < high, not {distortion_range}")
    radius2 = squared_radii(points).max(axis=(0, 1))
    lows = np.maximum(low, -(1.0 - _MIN_DEPTH) / np.maximum(radius2, 1e-300))
    first, second = np.triu_indices(points.shape[2], 1)
    nearest2 = squared_radii(np.take(points, first, axis=2) - np.take(points, second, axis=2)).min(axis=(0, 1))
    lows[~(nearest2 > _MIN_SEPARATION**2 * radius2)] = np.inf
    return lows, np.minimum(high, (1.0 - _MIN_DEPTH) / np.maximum(radius2, 1e-300))


def plane_points(points: FloatArray, rotations: TiltRotations, distortion: FloatArray) -> FloatArray:
    """Plane coordinates of points (2, 2, k, b) for one λ a sample (b,); shape (2, 2, k, b)."""
    x, y = points
    r = rotations.matrices
    seen = r[0] * x + r[1] * y + r[2] * (1.0 + distortion * squared_radii(points))
    return np.asarray(seen[:2] / seen[2])


def motion_homography(
    points: FloatArray, rotations: TiltRotations, distortion: FloatArray, height_free: bool = False
) -> FloatArray:
    """Homography ``R2 Rz(φ) diag(1, 1, height) T R1'`` (b, 3, 3) of the plane motion that fits the points best.

    The least-squares rigid motion, or similarity, of the plane points (2, 2, k, b) at a λ (b,): as complex numbers
    about their means, ``Σ conj(X) X̂`` has φ as its argument, and over ``Σ |X|²`` the scale, 1 / height, as its
    modulus.
    """
    plane = plane_points(points, rotations, distortion)
    mean = plane.mean(axis=2)
    (ax, bx), (ay, by) = plane - mean[:, :, None]
    along, across = (ax * bx + ay * by).sum(axis=0), (ax * by - ay * bx).sum(axis=0)
    length = np.sqrt(along * along + across * across)
    c, s = along / length, across / length
    height = (ax * ax + ay * ay).sum(axis=0) / length if height_free else 1.0
    (x1, x2), (y1, y2) = mean
    tx, ty = height * x2 - (c * x1 - s * y1), height * y2 - (s * x1 + c * y1)
    r1, r2 = rotations.matrices[:, :, 0, 0], rotations.matrices[:, :, 1, 0]
    right, down, normal = r1[:, 0], r1[:, 1], r1[:, 2]
    homography = (
        r2[:, 0, None] * (c * right - s * down + tx * normal)
        + r2[:, 1, None] * (s * right + c * down + ty * normal)
        + r2[:, 2, None] * (height * normal)
    )
    return np.ascontiguousarray(homography.transpose(2, 0, 1))
