"""From homographies of a plane to poses of one camera: planar self-calibration (Triggs, ECCV 1998).

Homographies between images leave the plane's metric open. In the camera of the reference image the plane has a
normal, two angles; with it and the focal length f every plane-to-image homography becomes ``diag(f, f, 1) [a b c]``
with ``a`` and ``b`` orthogonal and of the same length. These two conditions an image give normal and f. They are few
unknowns, so all of them are tried on a grid, from which the adjustment finds the minimum.
"""

import math

import numpy as np

from rdstitch.alignment.motion_models import LOG_HEIGHT, PSI, THETA, YAW, X, Y
from rdstitch.arrays import FloatArray
from rdstitch.geometry.planar_motion import rotation_from_tilt, tilt_from_normal
from rdstitch.geometry.radial_homography import inverses

_MAX_TILT = math.radians(75.0)
_TILT_STEPS = 31  # five degrees a step, less than the adjustment bridges
_FOCAL_RANGE = np.linspace(-1.5, 1.5, 7)  # standard deviations of the prior on log f

_AT_ONCE = 2**15
"""Images times tilts whose conditions are looked at together: more of them take memory, and no less time."""

_OUTLYING = 0.3  # error of the two conditions, relative, beyond which all errors count alike


def metric_upgrade(
    homographies: FloatArray, reference: int, log_focal: float, log_focal_std: float
) -> tuple[FloatArray, FloatArray]:
    """The poses (N, 6) of one camera that come nearest to plane-to-image homographies; its tilt, radians, and log f.

    ``homographies`` (N, 3, 3): from any frame of the plane to undistorted coordinates of the images, half diagonals,
    with positive third coordinates in front of the camera; ``reference``: image that lies at the origin of the plane,
    at height one; ``log_focal, log_focal_std``: prior on the logarithm of the focal length in half diagonals.
    """
    relative = homographies @ inverses(homographies[reference : reference + 1])[0]
    angles = np.linspace(-_MAX_TILT, _MAX_TILT, _TILT_STEPS)
    tilts = np.stack(np.meshgrid(angles, angles, indexing="ij"), axis=-1).reshape(-1, 2)
    best, best_cost, best_focal = tilts[0], math.inf, log_focal
    for step in _FOCAL_RANGE:
        focal = log_focal + step * log_focal_std
        cost = _cost(relative, tilts, focal) + step**2 * _OUTLYING**2 / len(homographies)
        index = int(np.argmin(cost))
        if cost[index] < best_cost:
            best, best_cost, best_focal = tilts[index], float(cost[index]), focal
    return _decomposed(relative, best, best_focal)


def _cost(relative: FloatArray, tilts: FloatArray, log_focal: float) -> FloatArray:
    """Mean truncated squared error of the conditions (T,) of the N images for each of T tilts of the reference."""
    costs = []
    for block in np.array_split(tilts, min(math.ceil(len(tilts) * len(relative) / _AT_ONCE), len(tilts))):
        metric = _metric(relative, block, log_focal)
        # By coordinate: sums and cross products along an axis of three take most of the time otherwise.
        a, b, c = np.ascontiguousarray(np.moveaxis(metric, (3, 2), (0, 1)))
        aa, bb, ab = (p[0] * q[0] + p[1] * q[1] + p[2] * q[2] for p, q in ((a, a), (b, b), (a, b)))
        error = ((aa - bb) ** 2 + (2.0 * ab) ** 2) / np.maximum(aa + bb, 1e-300) ** 2
        across = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        front = c[0] * across[0] + c[1] * across[1] + c[2] * across[2]
        costs.append(np.where(front <= 0.0, _OUTLYING**2, np.minimum(error, _OUTLYING**2)).mean(axis=1))
    return np.concatenate(costs)


def _metric(relative: FloatArray, tilts: FloatArray, log_focal: float) -> FloatArray:
    """``diag(f, f, 1)⁻¹ G_i diag(f, f, 1) R`` (T, N, 3, 3) for tilts (T, 2) of the reference."""
    calibration = np.exp([log_focal, log_focal, 0.0])
    normalized = relative / calibration[:, None] * calibration
    # One product of two matrices: one for each tilt and image takes ten times as long.
    product = normalized.reshape(-1, 3) @ np.moveaxis(rotation_from_tilt(tilts), 0, 1).reshape(3, -1)
    return product.reshape(-1, 3, len(tilts), 3).transpose(2, 0, 1, 3)


def _decomposed(relative: FloatArray, tilt: FloatArray, log_focal: float) -> tuple[FloatArray, FloatArray]:
    """The nearest poses: ``[a b c] ~ R Rz(φ) [e1 e2 (-t, h)]``."""
    metric = _metric(relative, tilt[None], log_focal)[0]
    left, _, right = np.linalg.svd(metric[:, :, :2], full_matrices=False)
    axes = left @ right  # orthonormal, nearest to a and b
    size = np.einsum("nij,nij->n", axes, metric[:, :, :2]) / 2.0
    normal = np.cross(axes[:, :, 0], axes[:, :, 1])
    normal *= np.where(normal[:, 2] < 0.0, -1.0, 1.0)[:, None]
    tilts = tilt_from_normal(normal)
    flat = np.swapaxes(rotation_from_tilt(tilts), 1, 2) @ metric / np.maximum(size, 1e-300)[:, None, None]
    yaw = np.arctan2(flat[:, 1, 0] - flat[:, 0, 1], flat[:, 0, 0] + flat[:, 1, 1])
    c, s = np.cos(yaw), np.sin(yaw)
    shared = np.median(tilts, axis=0)
    poses = np.zeros((len(relative), 6))
    poses[:, YAW] = yaw
    poses[:, X] = -(c * flat[:, 0, 2] + s * flat[:, 1, 2]) * math.exp(log_focal)
    poses[:, Y] = -(-s * flat[:, 0, 2] + c * flat[:, 1, 2]) * math.exp(log_focal)
    poses[:, LOG_HEIGHT] = np.log(np.clip(np.abs(flat[:, 2, 2]), 1e-3, 1e3))
    poses[:, [PSI, THETA]] = (tilts - shared) / math.exp(log_focal)
    return poses, np.array([*shared, log_focal])
