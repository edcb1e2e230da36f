"""How an image's pose and the camera's shared parameters make a homography: the family of motion models.

Every model gives, for each image i, the homography ``P_i`` from the plane to the image's undistorted coordinates
(half diagonals from the distortion centre), and its derivatives; the adjustment uses nothing else of a model. Two
images are related by ``H_ij = P_j P_i⁻¹``.

From the least to the most free:

========== =============================================== ===================================================
model      per image                                     image
========== =============================================== ===================================================
rigid      φ, tx, ty                                       robot: tilt and height stay (Valtonen Örnhag et al.)
similarity φ, tx, ty, log h                                drone that climbs and sinks
tilting    φ, tx, ty, log h, δψ, δθ                        drone in wind: small tilts of its own
pose       φ, tx, ty, log h, δψ, δθ                        kite, hand: any pose of one camera, six degrees of freedom
homography 8                                               any motion, any camera
========== =============================================== ===================================================

All but the last share the tilt (ψ, θ) and the focal length:
``P_i = diag(f, f, 1) Rx(ψ + δψ_i) Ry(θ + δθ_i) Rz(φ_i) diag(1, 1, h_i) T(t_i)``, ``T = I - t e3'``.

The images see ψ/f, θ/f, their own δψ/f and δθ/f, and f t far better than f itself. The adjustment therefore moves
those; otherwise it would have to follow a curved valley, and a prior on small tilts would ask for a short f.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.planar_motion import ABOUT_X, ABOUT_Y, nearest_in_plane, rigid_in_plane, rotation_from_tilt

YAW, X, Y, LOG_HEIGHT, PSI, THETA = range(6)
"""Columns of a planar model's poses."""

_MAX_LOG_HEIGHT = 10.0  # where the model does not describe the motion, heights may diverge

_TRACELESS = np.zeros((8, 3, 3))
_TRACELESS[[0, 1, 2, 3, 4, 5], [0, 0, 1, 1, 2, 2], [1, 2, 0, 2, 0, 1]] = 1.0
_TRACELESS[6] = np.diag([1.0, -1.0, 0.0]) / np.sqrt(2.0)
_TRACELESS[7] = np.diag([1.0, 1.0, -2.0]) / np.sqrt(6.0)


@dataclass(frozen=True)
class ModelMatrices:
    """Plane-to-image homographies of N images with their derivatives.

    Attributes
    ----------
    matrices : ndarray of shape (N, 3, 3)
    by_pose : ndarray of shape (N, D, 3, 3)
        By a step of the D pose parameters, as :meth:`MotionModel.retract` takes it.
    by_shared : ndarray of shape (N, S, 3, 3)
        By the S shared parameters.
    """

    matrices: FloatArray
    by_pose: FloatArray
    by_shared: FloatArray


class MotionModel(Protocol):
    """A motion model, as the adjustment uses it."""

    @property
    def name(self) -> str:
        """One word for it."""

    @property
    def pose_size(self) -> int:
        """Free parameters per image, D."""

    @property
    def on_sphere(self) -> bool:
        """Whether images lie around one centre, not over a plane."""

    @property
    def shared_names(self) -> tuple[str, ...]:
        """Parameters that all images share, S of them, without those of the lens."""

    @property
    def gauge(self) -> BoolArray:
        """Gauge: which of the D parameters of the reference image the choice of the frame fixes, shape (D,)."""

    def matrices(self, poses: FloatArray, shared: FloatArray) -> ModelMatrices:
        """Homographies from the plane to the images, with derivatives."""

    def physical_parameters(self, shared: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What :attr:`shared_names` names (S,), and its derivatives by the shared parameters (S, S)."""

    def shared_from_physical(self, physical: FloatArray) -> FloatArray:
        """The inverse of :meth:`physical_parameters`."""

    def retract(self, poses: FloatArray, step: FloatArray) -> FloatArray:
        """Poses after a step of shape (N, D)."""

    def prior_coordinates(self, poses: FloatArray) -> FloatArray:
        """The D parameters of each image (N, D) that priors are on; zeros where there can be none."""

    def origins(self, shared: FloatArray, attitudes: FloatArray) -> FloatArray:
        """Homographies (N, 3, 3) of images at the origin of the plane, with the tilts (N, 2) given."""

    def nearest_poses(self, homographies: FloatArray, shared: FloatArray, attitudes: FloatArray) -> FloatArray:
        """The poses with these tilts (N, 2) that come nearest to plane-to-image homographies (N, 3, 3)."""


@dataclass(frozen=True)
class PlanarModel:
    """Camera that moves over a plane with a tilt that it keeps, or nearly keeps.

    Poses have six columns, :data:`YAW` to :data:`THETA`, of which only the free ones move; positions are multiplied by
    the focal length, tilts that are free divided by it. The shared parameters are ψ/f, θ/f and log f.

    Attributes
    ----------
    name : str
    free : tuple of int
        The free columns.
    """

    name: str
    free: tuple[int, ...]
    shared_names: tuple[str, ...] = ("psi", "theta", "log_focal")
    on_sphere: bool = False

    @property
    def pose_size(self) -> int:
        """Free parameters per image."""
        return len(self.free)

    @property
    def gauge(self) -> BoolArray:
        """A rigid motion of the plane, and its scale where heights are free; tilts do not depend on the frame."""
        return np.array([column not in (PSI, THETA) for column in self.free])

    def matrices(self, poses: FloatArray, shared: FloatArray) -> ModelMatrices:
        """Homographies from the plane to the images, with derivatives."""
        count = len(poses)
        focal = np.exp(shared[2])
        calibration = np.diag([focal, focal, 1.0])
        tilts = self._tilts(poses, shared)
        rotation = rotation_from_tilt(tilts + shared[:2] * focal)
        motion, by_motion = _motion_in_plane(poses, focal)
        left = calibration @ rotation
        matrices = left @ motion

        by_tilt = np.stack([calibration @ ABOUT_X @ rotation @ motion, left @ ABOUT_Y @ motion], axis=1)
        by_columns = np.concatenate([left[:, None] @ by_motion, by_tilt * focal], axis=1)
        growing = shared[:2] * focal + (tilts if PSI in self.free else 0.0)
        by_focal = (
            matrices * np.array([1.0, 1.0, 0.0])[:, None]
            + np.einsum("nkij,nk->nij", by_tilt, np.broadcast_to(growing, (count, 2)))
            - np.einsum("nkij,nk->nij", by_columns[:, [X, Y]], poses[:, [X, Y]])
        )
        by_shared = np.concatenate([by_tilt * focal, by_focal[:, None]], axis=1)
        return ModelMatrices(matrices, by_columns[:, list(self.free)].reshape(count, -1, 3, 3), by_shared)

    def physical_parameters(self, shared: FloatArray) -> tuple[FloatArray, FloatArray]:
        """ψ, θ and log f, with derivatives."""
        focal = float(np.exp(shared[2]))
        physical = np.array([shared[0] * focal, shared[1] * focal, shared[2]])
        derivative = np.diag([focal, focal, 1.0])
        derivative[:2, 2] = physical[:2]
        return physical, derivative

    def shared_from_physical(self, physical: FloatArray) -> FloatArray:
        """ψ/f, θ/f and log f."""
        return np.append(physical[:2] / np.exp(physical[2]), physical[2])

    def retract(self, poses: FloatArray, step: FloatArray) -> FloatArray:
        """Poses after a step of shape (N, D)."""
        result = poses.copy()
        result[:, list(self.free)] += step
        result[:, LOG_HEIGHT] = np.clip(result[:, LOG_HEIGHT], -_MAX_LOG_HEIGHT, _MAX_LOG_HEIGHT)
        return result

    def prior_coordinates(self, poses: FloatArray) -> FloatArray:
        """The free parameters themselves."""
        return poses[:, list(self.free)]

    def _tilts(self, poses: FloatArray, shared: FloatArray) -> FloatArray:
        """How the tilts of the images differ from the shared one (N, 2), radians."""
        own: FloatArray = poses[:, [PSI, THETA]] * (np.exp(shared[2]) if PSI in self.free else 1.0)
        return own

    def _tilted(self, tilts: FloatArray, shared: FloatArray) -> FloatArray:
        """Poses (N, 6) at the origin with tilts (N, 2) that differ by so much from the shared one, radians."""
        poses = np.zeros((len(tilts), 6))
        poses[:, [PSI, THETA]] = tilts / (np.exp(shared[2]) if PSI in self.free else 1.0)
        return poses

    def metric_poses(self, poses: FloatArray, shared: FloatArray) -> FloatArray:
        """Poses (N, 6) with positions in units of the height, and with the whole tilt, radians."""
        focal = np.exp(shared[2])
        result = poses.copy()
        result[:, [X, Y]] /= focal
        result[:, [PSI, THETA]] = self._tilts(poses, shared) + shared[:2] * focal
        return result

    def taken_over(self, other: "PlanarModel", poses: FloatArray, shared: FloatArray) -> FloatArray:
        """Poses (N, 6) of another planar model in the units of this one."""
        result = poses.copy()
        result[:, [PSI, THETA]] = self._tilted(other._tilts(poses, shared), shared)[:, [PSI, THETA]]
        return result

    def origins(self, shared: FloatArray, attitudes: FloatArray) -> FloatArray:
        """``diag(f, f, 1) R_i``."""
        poses = self._tilted(attitudes, shared)
        matrices: FloatArray = self.matrices(poses, shared).matrices
        return matrices

    def nearest_poses(self, homographies: FloatArray, shared: FloatArray, attitudes: FloatArray) -> FloatArray:
        """The nearest poses, given how the tilts of the images differ from the shared one."""
        poses = self._tilted(attitudes, shared)
        motion = np.linalg.inv(self.origins(shared, attitudes)) @ homographies
        poses[:, YAW], translation, height = nearest_in_plane(motion)
        poses[:, [X, Y]] = translation * np.exp(shared[2])
        if LOG_HEIGHT in self.free:
            poses[:, LOG_HEIGHT] = np.log(np.clip(np.abs(height), 1e-3, 1e3))
        return poses


def _motion_in_plane(poses: FloatArray, focal: float) -> tuple[FloatArray, FloatArray]:
    """``Rz(φ) diag(1, 1, h) T`` (N, 3, 3) and its derivatives by φ, f tx, f ty, log h (N, 4, 3, 3)."""
    motion = rigid_in_plane(poses[:, YAW], poses[:, [X, Y]] / focal, np.exp(poses[:, LOG_HEIGHT]))
    c, s = motion[:, 0, 0], motion[:, 1, 0]
    derivatives = np.zeros((len(poses), 4, 3, 3))
    derivatives[:, 0, 0], derivatives[:, 0, 1] = -motion[:, 1], motion[:, 0]
    derivatives[:, 1, 0, 2], derivatives[:, 1, 1, 2] = -c / focal, -s / focal
    derivatives[:, 2, 0, 2], derivatives[:, 2, 1, 2] = s / focal, -c / focal
    derivatives[:, 3, 2, 2] = motion[:, 2, 2]
    return motion, derivatives


@dataclass(frozen=True)
class HomographyModel:
    """One homography per image: eight parameters, a step being ``P ← exp(Σ δ_k E_k) P``.

    The step acts in the image's frame, where coordinates are of order one however far away the image lies. ``E_k``
    span the matrices without trace: only so does a change of the plane's frame, ``P M P⁻¹`` in every image, leave
    all relations of images as they are, to any order. Poses are P, row by row.
    """

    name: str = "homography"
    pose_size: int = 8
    shared_names: tuple[str, ...] = ()
    on_sphere: bool = False

    @property
    def gauge(self) -> BoolArray:
        """All of the reference image: the plane may be mapped by any homography."""
        return np.ones(8, dtype=np.bool_)

    def matrices(self, poses: FloatArray, shared: FloatArray) -> ModelMatrices:
        """Homographies from the plane to the images, with derivatives."""
        matrices = poses.reshape(-1, 3, 3)
        return ModelMatrices(matrices, _TRACELESS @ matrices[:, None], np.zeros((len(poses), 0, 3, 3)))

    def physical_parameters(self, shared: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Nothing."""
        return np.zeros(0), np.zeros((0, 0))

    def shared_from_physical(self, physical: FloatArray) -> FloatArray:
        """Nothing."""
        return np.zeros(0)

    def retract(self, poses: FloatArray, step: FloatArray) -> FloatArray:
        """Poses after a step of shape (N, 8)."""
        change = np.einsum("nk,kij->nij", step, _TRACELESS)
        growth = np.eye(3) + change @ (np.eye(3) + change / 2.0)  # exp to second order
        return _unit_determinant(growth @ poses.reshape(-1, 3, 3))

    def prior_coordinates(self, poses: FloatArray) -> FloatArray:
        """Zeros: homographies have no prior."""
        return np.zeros((len(poses), 8))

    def origins(self, shared: FloatArray, attitudes: FloatArray) -> FloatArray:
        """The identity."""
        return np.tile(np.eye(3), (len(attitudes), 1, 1))

    def nearest_poses(self, homographies: FloatArray, shared: FloatArray, attitudes: FloatArray) -> FloatArray:
        """The homographies themselves."""
        return _unit_determinant(homographies)


def inverses(matrices: FloatArray) -> FloatArray:
    """Inverses of (N, 3, 3) by cofactors; not finite where a step made a matrix singular."""
    (a, b, c), (d, e, f), (g, h, i) = matrices.transpose(1, 2, 0)
    cofactors = np.empty((3, 3, len(matrices)))
    with np.errstate(all="ignore"):
        cofactors[:, 0] = e * i - f * h, f * g - d * i, d * h - e * g
        cofactors[:, 1] = c * h - b * i, a * i - c * g, b * g - a * h
        cofactors[:, 2] = b * f - c * e, c * d - a * f, a * e - b * d
        cofactors /= a * cofactors[0, 0] + b * cofactors[1, 0] + c * cofactors[2, 0]
    return np.ascontiguousarray(cofactors.transpose(2, 0, 1))


def _unit_determinant(matrices: FloatArray) -> FloatArray:
    """Scaled to determinant ±1 without changing sign, flattened to (N, 9)."""
    size = np.cbrt(np.maximum(np.abs(np.linalg.det(matrices)), 1e-300))
    scaled: FloatArray = matrices / size[:, None, None]
    return scaled.reshape(-1, 9)


RIGID = PlanarModel("rigid", (YAW, X, Y))
SIMILARITY = PlanarModel("similarity", (YAW, X, Y, LOG_HEIGHT))
TILTING = PlanarModel("tilting", (YAW, X, Y, LOG_HEIGHT, PSI, THETA))
POSE = PlanarModel("pose", (YAW, X, Y, LOG_HEIGHT, PSI, THETA))
HOMOGRAPHY = HomographyModel()
PLANAR_MODELS: dict[str, MotionModel] = {model.name: model for model in (RIGID, SIMILARITY, TILTING, POSE, HOMOGRAPHY)}
"""The family by name, from the least to the most free."""
