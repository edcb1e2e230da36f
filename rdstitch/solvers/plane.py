"""The plane as cameras of known tilt see it: plane coordinates, distances, and motions in the plane.

Inside a solver the batch axis is last: points of a picture have shape (k, 2, B). With the tilt's rotation R and the
plane normal ``n = R e3``, a lifted point ``p(λ) = (x, y, 1 + λ r²)`` has the plane coordinates
``X = (R' p)_xy / (n · p)``. The vector between two points of the plane is
``X_i - X_j = J (R' (p_i × p_j))_xy / ((n · p_i)(n · p_j))``, J a quarter turn: both its numerator and the depths
``n · p`` are linear in λ.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.camera import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.planar_motion import rotation_from_tilt

# Depths and lens factors below this count as at the horizon or at the fold of the lens.
_MIN_DEPTH = 1e-9
# Points nearer than this, relative to their distance from the centre, count as coincident.
_MIN_SEPARATION = 1e-9


@dataclass(frozen=True)
class TiltRotations:
    """Rotations of the two pictures' tilts, of shape (3, 3, 1), or (3, 3, B) when each sample has its own."""

    first: FloatArray
    second: FloatArray

    @classmethod
    def from_tilt(cls, tilt: ArrayLike, count: int) -> Self:
        """From one tilt (2,), one a picture (2, 2), or one a sample and picture (B, 2, 2).

        Raises
        ------
        ArgumentError
            When the shape is another, a value is not finite, or the camera does not look at the plane.
        """
        angles = np.asarray(tilt, dtype=np.float64)
        if angles.shape not in ((2,), (2, 2), (count, 2, 2)):
            raise ArgumentError(f"tilt must be (psi, theta) or one such pair a picture, not of shape {angles.shape}")
        if not (np.abs(angles) < np.pi / 2).all():
            raise ArgumentError("tilt must be below a right angle")
        both = np.broadcast_to(angles, (*angles.shape[:-2], 2, 2)).reshape(-1, 2, 2)
        first, second = np.moveaxis(rotation_from_tilt(both), 0, -1)
        return cls(np.ascontiguousarray(first), np.ascontiguousarray(second))

    def take(self, samples: NDArray[np.intp]) -> Self:
        """Those of some samples; indices may repeat."""
        if self.first.shape[-1] == 1:
            return self
        return type(self)(np.take(self.first, samples, axis=-1), np.take(self.second, samples, axis=-1))


def depths(x: FloatArray, rotation: FloatArray) -> FloatArray:
    """Depths ``n · p(λ)`` of points (k, 2, B): constant and slope, shape (2, k, B)."""
    nx, ny, nz = rotation[:, 2]
    radius2 = x[:, 0] ** 2 + x[:, 1] ** 2
    return np.stack([nx * x[:, 0] + ny * x[:, 1] + nz, nz * radius2])


def differences(x: FloatArray, rotation: FloatArray, pairs: tuple[tuple[int, int], ...]) -> FloatArray:
    """Numerators ``J (R' (p_i × p_j))_xy`` of ``X_i - X_j`` for pairs of points (k, 2, B).

    Returns
    -------
    ndarray of shape (2, 2, len(pairs), B)
        Constant and slope in λ; x and y.
    """
    i, j = ([pair[end] for pair in pairs] for end in (0, 1))
    (xi, yi), (xj, yj) = x[i].swapaxes(0, 1), x[j].swapaxes(0, 1)
    ri, rj = xi**2 + yi**2, xj**2 + yj**2
    dx, dy = xi - xj, yi - yj
    third = yj * dx - xj * dy
    r = rotation
    lengthwise = np.stack(
        [-(r[0, 1] * dy - r[1, 1] * dx + r[2, 1] * third), r[0, 0] * dy - r[1, 0] * dx + r[2, 0] * third]
    )
    cx, cy = yi * rj - yj * ri, ri * xj - rj * xi
    slope = np.stack([-(r[0, 1] * cx + r[1, 1] * cy), r[0, 0] * cx + r[1, 0] * cy])
    return np.stack([lengthwise, slope])


def visible_range(
    x1: FloatArray, x2: FloatArray, rotations: TiltRotations, distortion_range: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """The λ for which all points lie within the lens model and in front of the camera, and no two coincide.

    ``1 + λ r²`` and the depth of each point are linear in λ, so that each leaves a half-line.

    Returns
    -------
    low, high : ndarray of shape (B,)
        Empty, ``low > high``, for a degenerate sample.
    """
    low, high = lens_range(x1, x2, distortion_range)
    for x, rotation in ((x1, rotations.first), (x2, rotations.second)):
        constant, slope = depths(x, rotation)
        # No slope is negative. At the centre it is 0, and the bound as infinite as it should be.
        low = np.maximum(low, ((_MIN_DEPTH - constant) / slope).max(axis=0))
    return low, high


def lens_range(x1: FloatArray, x2: FloatArray, distortion_range: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """The λ for which all points lie within the lens model, none if two points coincide; see :func:`visible_range`."""
    low, high = distortion_range
    if not low < high:
        raise ArgumentError(f"distortion range must be (low, high) with low < high, not {distortion_range}")
    radius2 = np.maximum(np.einsum("kib,kib->kb", x1, x1), np.einsum("kib,kib->kb", x2, x2)).max(axis=0)
    lows = np.maximum(low, -(1.0 - _MIN_DEPTH) / np.maximum(radius2, 1e-300))
    apart = distinct(x1, radius2) & distinct(x2, radius2)
    return np.where(apart, lows, np.inf), np.full_like(lows, high)


def distinct(x: FloatArray, radius2: FloatArray) -> NDArray[np.bool_]:
    """Whether no two of the points (k, 2, B) coincide, relative to ``radius2``; shape (B,)."""
    first, second = np.triu_indices(len(x), 1)
    between = x[first] - x[second]
    distance2 = between[:, 0] ** 2 + between[:, 1] ** 2
    return np.asarray((distance2 > _MIN_SEPARATION**2 * radius2).all(axis=0))


def plane_points(x: FloatArray, rotation: FloatArray, distortion: FloatArray) -> FloatArray:
    """Plane coordinates of points (k, 2, M) for one λ a sample (M,); shape (k, 2, M)."""
    third = 1.0 + distortion * (x[:, 0] ** 2 + x[:, 1] ** 2)
    r = rotation
    q = [r[0, i] * x[:, 0] + r[1, i] * x[:, 1] + r[2, i] * third for i in range(3)]
    return np.stack([q[0] / q[2], q[1] / q[2]], axis=1)


def motion_homography(
    x1: FloatArray, x2: FloatArray, rotations: TiltRotations, distortion: FloatArray, height_free: bool = False
) -> FloatArray:
    """Homography ``R2 Rz(φ) diag(1, 1, height) T R1'`` of the plane motion that fits the points best.

    The least-squares rigid motion, or similarity, of the plane points: as complex numbers about their means,
    ``Σ conj(X) X̂`` has φ as its argument, and over ``Σ |X|²`` the scale, 1 / height, as its modulus.

    Parameters
    ----------
    x1, x2 : ndarray of shape (k, 2, M)
    distortion : ndarray of shape (M,)

    Returns
    -------
    ndarray of shape (M, 3, 3)
    """
    first = plane_points(x1, rotations.first, distortion)
    second = plane_points(x2, rotations.second, distortion)
    mean1, mean2 = first.mean(axis=0), second.mean(axis=0)
    (ax, ay), (bx, by) = (first - mean1).swapaxes(0, 1), (second - mean2).swapaxes(0, 1)
    along = np.einsum("km,km->m", ax, bx) + np.einsum("km,km->m", ay, by)
    across = np.einsum("km,km->m", ax, by) - np.einsum("km,km->m", ay, bx)
    length = np.sqrt(along**2 + across**2)
    c, s = along / length, across / length
    height = np.einsum("kim,kim->m", first - mean1, first - mean1) / length if height_free else 1.0
    tx = height * mean2[0] - (c * mean1[0] - s * mean1[1])
    ty = height * mean2[1] - (s * mean1[0] + c * mean1[1])
    r1, r2 = rotations.first, rotations.second
    moved = np.stack(
        [
            c * r1[:, 0] - s * r1[:, 1] + tx * r1[:, 2],
            s * r1[:, 0] + c * r1[:, 1] + ty * r1[:, 2],
            np.broadcast_to(height * r1[:, 2], (3, len(distortion))),
        ]
    )
    homography = r2[:, 0, None] * moved[0] + r2[:, 1, None] * moved[1] + r2[:, 2, None] * moved[2]
    return np.ascontiguousarray(np.moveaxis(homography, -1, 0))
