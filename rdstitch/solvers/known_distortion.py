"""Minimal solvers for a lens that is known already: λ comes from a camera file."""

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.solvers.batch import IndexArray, sample_count, solve_in_blocks
from rdstitch.solvers.homography import Quadrangles
from rdstitch.solvers.plane import TiltRotations, depths, lens_range, motion_homography, visible_range
from rdstitch.solvers.solutions import Solutions


def two_point_rigid(x1: ArrayLike, x2: ArrayLike, distortion: ArrayLike, tilt: ArrayLike = (0.0, 0.0)) -> Solutions:
    """Planar motion from two points, for known λ and tilt: the least-squares rigid motion of the plane points.

    Parameters
    ----------
    x1, x2 : array_like of shape (B, 2, 2) or (2, 2)
        Focal-normalized points of image 1 and image 2.
    distortion : array_like of shape () or (B,)
        λ, focal-normalized.
    tilt : array_like of shape (2,), (2, 2) or (B, 2, 2)
        (ψ, θ) of the camera, radians; or one such pair an image; or one a sample and image.

    Returns
    -------
    Solutions
        One a sample, or none where a point is behind the camera or outside the lens model, or points coincide.
    """
    return _motion(x1, x2, distortion, tilt, height_free=False)


def two_point_similarity(
    x1: ArrayLike, x2: ArrayLike, distortion: ArrayLike, tilt: ArrayLike = (0.0, 0.0)
) -> Solutions:
    """Planar motion with a change of height from two points, for known λ and tilt; as :func:`two_point_rigid`."""
    return _motion(x1, x2, distortion, tilt, height_free=True)


def four_point_dlt(x1: ArrayLike, x2: ArrayLike, distortion: ArrayLike) -> Solutions:
    """Any homography from four points, for known λ, in closed form (:mod:`rdstitch.solvers.homography`).

    Parameters
    ----------
    x1, x2 : array_like of shape (B, 4, 2) or (4, 2)
        Normalized points of image 1 and image 2.
    distortion : array_like of shape () or (B,)
        λ in the frame of the points.

    Returns
    -------
    Solutions
        One a sample, or none where three points are collinear, change sides or are mirrored, or a point is outside the
        lens model.
    """
    lam = distortions(distortion, x1)

    def solve(points: FloatArray, samples: IndexArray) -> Solutions:
        given = lam[samples]
        low, high = lens_range(points, (-np.inf, np.inf))
        h, possible = Quadrangles.of(points).homography(given)
        index = np.flatnonzero(possible & (given > low) & (given < high))
        return Solutions(index, h[index], given[index])

    return solve_in_blocks(solve, x1, x2, 4)


def _motion(x1: ArrayLike, x2: ArrayLike, distortion: ArrayLike, tilt: ArrayLike, *, height_free: bool) -> Solutions:
    """Motion in the plane from two points."""
    rotations = TiltRotations.from_tilt(tilt, sample_count(x1))
    lam = distortions(distortion, x1)

    def solve(points: FloatArray, samples: IndexArray) -> Solutions:
        given, rotation = lam[samples], rotations.take(samples)
        low, high = visible_range(points, depths(points, rotation), (-np.inf, np.inf))
        index = np.flatnonzero((given > low) & (given < high))
        h = motion_homography(np.take(points, index, axis=-1), rotation.take(index), given[index], height_free)
        return Solutions(index, h, given[index])

    return solve_in_blocks(solve, x1, x2, 2)


def distortions(distortion: ArrayLike, x1: ArrayLike) -> FloatArray:
    """λ of every sample of a batch, from one for all or one for each."""
    lam = np.asarray(distortion, dtype=np.float64)
    count = sample_count(x1)
    if lam.shape not in ((), (count,)) or not np.isfinite(lam).all():
        raise ArgumentError(f"distortion must be a finite number or one a sample, not {distortion!r}")
    return np.broadcast_to(lam, (count,))
