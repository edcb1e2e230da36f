"""Problem instances with known truth, in batches: what the minimal solvers are tested and measured with."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from rdstitch.arrays import FloatArray
from rdstitch.geometry.division_model import distort, divisor
from rdstitch.geometry.planar_motion import PlanarMotion, rigid_in_plane, rotation_from_tilt
from rdstitch.geometry.radial_homography import project
from rdstitch.solvers.solutions import Solutions

Range = tuple[float, float]
IndexArray = NDArray[np.intp]

# Half width and half height of a 4:3 image in focal lengths. Its half diagonal is one focal length, so that
# λ has the same value in the focal-normalized and in the half-diagonal frame.
HALF_SIZE = (0.8, 0.6)

# Rays meet the plane within ten heights of the camera: what lies nearer to the horizon is no use to anybody.
_MIN_STEEPNESS = 0.1
_MAX_ROUNDS = 200


def lift(points: ArrayLike, distortion: ArrayLike) -> FloatArray:
    """``(x, y, 1 + λ r²)`` of normalized points (..., 2); shape (..., 3). λ broadcasts."""
    x = np.asarray(points, dtype=np.float64)
    third = divisor(np.einsum("...i,...i->...", x, x), distortion)
    return np.concatenate([np.broadcast_to(x, (*third.shape, 2)), third[..., None]], axis=-1)


@dataclass(frozen=True)
class Instances:
    """B instances of k correspondences between two images of a plane; points and λ are focal-normalized."""

    x1: FloatArray  # measured, noisy; shape (B, k, 2)
    x2: FloatArray
    homography: FloatArray  # p2(λ) ~ H p1(λ) with positive third coordinates; shape (B, 3, 3)
    distortion: FloatArray

    def __len__(self) -> int:
        return len(self.distortion)

    def best_errors(self, solutions: Solutions) -> tuple[FloatArray, FloatArray]:
        """Errors of λ and of H (of unit norm, up to sign) of each sample's solution nearest in λ; inf where none is."""
        distortion_error = np.full(len(self), np.inf)
        homography_error = np.full(len(self), np.inf)
        sample = solutions.sample
        error = np.abs(solutions.distortion - self.distortion[sample])
        order = np.lexsort((error, sample))
        first = order[np.r_[True, np.diff(sample[order]) > 0]] if len(order) else order
        distortion_error[sample[first]] = error[first]
        found, true = (
            h / np.linalg.norm(h, axis=(1, 2), keepdims=True)
            for h in (solutions.homography[first], self.homography[sample[first]])
        )
        both = [np.linalg.norm(found + sign * true, axis=(1, 2)) for sign in (-1.0, 1.0)]
        homography_error[sample[first]] = np.minimum(*both)
        return distortion_error, homography_error


@dataclass(frozen=True)
class PlanarInstances(Instances):
    """Instances of planar motion: ``H = R2 Rz(φ) diag(1, 1, height) T R1'``."""

    tilt: FloatArray  # (ψ, θ) of image 1, radians; shape (B, 2)
    tilt2: FloatArray  # of image 2: the same unless separate tilts were requested
    yaw: FloatArray  # φ, radians
    translation: FloatArray  # in heights of the first camera above the plane; shape (B, 2)
    height: FloatArray  # of the second camera, in heights of the first

    def motion(self, index: int) -> PlanarMotion:
        """The motion of one instance whose two tilts are the same."""
        psi, theta = self.tilt[index]
        tx, ty = self.translation[index]
        yaw, height = self.yaw[index], self.height[index]
        return PlanarMotion((float(psi), float(theta)), float(yaw), (float(tx), float(ty)), float(height))


def planar_instances(
    count: int,
    points: int,
    *,
    seed: int,
    distortion: Range = (-0.7, 0.0),
    max_tilt: float = 0.3,
    separate_tilts: bool = False,
    yaw: Range = (-np.pi, np.pi),
    translation: Range = (0.1, 0.8),
    height: Range = (1.0, 1.0),
    half_size: Range = HALF_SIZE,
    overlap: float = 0.1,
    noise: float = 0.0,
) -> PlanarInstances:
    """Random planar motion over a plane, seen by a tilted camera with radial distortion.

    λ, yaw (radians), length of the translation and height are uniform in their ranges, tilts in ±``max_tilt`` radians;
    motions after which image 2 sees less than ``overlap`` of image 1, roughly, are drawn again. Points are uniform over
    the part of image 1 that is visible in image 2 and well below the horizon, with normal ``noise`` in both images.
    """
    rng = np.random.default_rng(seed)
    lam = rng.uniform(*distortion, count)
    tilt = rng.uniform(-max_tilt, max_tilt, (count, 2))
    tilt2 = rng.uniform(-max_tilt, max_tilt, (count, 2)) if separate_tilts else tilt
    rotation, rotation2 = rotation_from_tilt(tilt), rotation_from_tilt(tilt2)
    motion = np.empty((count, 4))  # φ, tx, ty, height

    def draw(which: IndexArray) -> FloatArray:
        direction, length = rng.uniform(-np.pi, np.pi, len(which)), rng.uniform(*translation, len(which))
        motion[which, 0] = rng.uniform(*yaw, len(which))
        motion[which, 1] = length * np.cos(direction)
        motion[which, 2] = length * np.sin(direction)
        motion[which, 3] = rng.uniform(*height, len(which))
        middle = rigid_in_plane(motion[which, 0], motion[which, 1:3], motion[which, 3])
        return rotation2[which] @ middle @ np.swapaxes(rotation[which], 1, 2)

    x1, x2, h = _visible_points(rng, lam, rotation[:, :, 2], points, half_size, overlap, noise, draw)
    return PlanarInstances(x1, x2, h, lam, tilt, tilt2, motion[:, 0], motion[:, 1:3], motion[:, 3])


def general_instances(
    count: int,
    points: int,
    *,
    seed: int,
    distortion: Range = (-0.7, 0.0),
    max_angle: float = 0.3,
    translation: Range = (0.1, 0.8),
    half_size: Range = HALF_SIZE,
    overlap: float = 0.1,
    noise: float = 0.0,
) -> Instances:
    """Random free motion before a plane: homographies with all eight degrees of freedom.

    ``H = Rx(α) Ry(β) Rz(φ) (I - t n')`` with the plane normal n and the attitude (α, β) tilted by up to
    ``max_angle`` about either axis, any yaw φ, and any direction of the translation t. Other parameters as for
    :func:`planar_instances`.
    """
    rng = np.random.default_rng(seed)
    lam = rng.uniform(*distortion, count)
    normal = rotation_from_tilt(rng.uniform(-max_angle, max_angle, (count, 2)))[:, :, 2]

    def draw(which: IndexArray) -> FloatArray:
        attitude = rotation_from_tilt(rng.uniform(-max_angle, max_angle, (len(which), 2)))
        yaw = rng.uniform(-np.pi, np.pi, len(which))
        turn = rigid_in_plane(yaw, np.zeros((len(which), 2)))
        t = rng.standard_normal((len(which), 3))
        t *= (rng.uniform(*translation, len(which)) / np.linalg.norm(t, axis=1))[:, None]
        return attitude @ turn @ (np.eye(3) - t[:, :, None] * normal[which][:, None, :])

    x1, x2, h = _visible_points(rng, lam, normal, points, half_size, overlap, noise, draw)
    return Instances(x1, x2, h, lam)


def _visible_points(
    rng: np.random.Generator,
    distortion: FloatArray,
    normal: FloatArray,
    points: int,
    half_size: Range,
    overlap: float,
    noise: float,
    draw: Callable[[IndexArray], FloatArray],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Draw points of image 1 and where image 2 sees them, both noisy, and H; motions without enough are drawn again."""
    count, drawn = len(distortion), int(np.ceil(points / overlap))
    half = np.asarray(half_size)
    x1, x2 = np.empty((count, points, 2)), np.empty((count, points, 2))
    h = np.empty((count, 3, 3))
    missing = np.arange(count)
    for _ in range(_MAX_ROUNDS):
        if not len(missing):
            x1 += noise * rng.standard_normal(x1.shape)
            x2 += noise * rng.standard_normal(x2.shape)
            return x1, x2, h
        motion = draw(missing)
        candidates = half * rng.uniform(-1.0, 1.0, (len(missing), drawn, 2))
        rays = lift(candidates, distortion[missing, None])
        seen = distort(project(rays @ np.swapaxes(motion, 1, 2)), distortion[missing, None])
        steepness = np.einsum("bki,bi->bk", rays, normal[missing]) / np.linalg.norm(rays, axis=-1)
        # NaN, a point that cannot be seen, compares as False.
        visible = (np.abs(seen) <= half).all(axis=-1) & (steepness > _MIN_STEEPNESS)
        first = np.argsort(~visible, axis=1, kind="stable")[:, :points, None]
        enough = visible.sum(axis=1) >= points
        x1[missing] = np.take_along_axis(candidates, first, axis=1)
        x2[missing] = np.take_along_axis(seen, first, axis=1)
        h[missing] = motion
        missing = missing[~enough]
    raise ValueError("these ranges give images that have too few points in common")


@dataclass(frozen=True)
class RotationInstances(Instances):
    """Instances of rotation: ``H = K R K⁻¹``, ``K = diag(g, g, 1)``."""

    rotation: FloatArray  # shape (B, 3, 3)
    focal: FloatArray  # g, in the unit of the points


def rotation_instances(
    count: int,
    points: int,
    *,
    seed: int,
    distortion: Range = (-0.7, 0.0),
    angle: Range = (0.1, 0.7),
    roll: float = np.pi,
    focal: Range = (1.0, 1.0),
    half_size: Range = HALF_SIZE,
    overlap: float = 0.1,
    noise: float = 0.0,
) -> RotationInstances:
    """Random rotations of a camera with radial distortion about its centre.

    ``angle`` is that between the optical axes, in any direction; ``roll`` the largest turn about the axis, radians.
    """
    rng = np.random.default_rng(seed)
    lam = rng.uniform(*distortion, count)
    length = rng.uniform(*focal, count)
    k = np.stack([length, length, np.ones(count)], axis=-1)

    def draw(which: np.ndarray) -> FloatArray:
        direction, by = rng.uniform(-np.pi, np.pi, len(which)), rng.uniform(*angle, len(which))
        turned = rng.uniform(-roll, roll, len(which))
        about = np.stack([by * np.cos(direction), by * np.sin(direction), 0.0 * by], axis=-1)
        turns = Rotation.from_rotvec(about) * Rotation.from_rotvec(turned[:, None] * np.array([0.0, 0.0, 1.0]))
        rotation = turns.as_matrix()
        return np.asarray(rotation * (k[which][:, :, None] / k[which][:, None, :]))

    # In front of image 1 every ray counts, however oblique: there is no plane that it should meet.
    ahead = np.tile([0.0, 0.0, 1.0], (count, 1))
    x1, x2, h = _visible_points(rng, lam, ahead, points, half_size, overlap, noise, draw)
    return RotationInstances(x1, x2, h, lam, h * (k[:, None, :] / k[:, :, None]), length)
