"""A camera that moves over a plane: ``P_i = diag(f, f, 1) Rx(ψ + δψ_i) Ry(θ + δθ_i) Rz(φ_i) diag(1, 1, h_i) T(t_i)``.

The images see ψ/f, θ/f, their own δψ/f and δθ/f, and f t far better than f itself. The adjustment therefore moves
those; otherwise it would have to follow a curved valley, and a prior on small tilts would ask for a short f.
"""

import math
from collections.abc import Sequence

import numpy as np

from rdstitch.alignment.motion_models.base import ModelMatrices, MotionModel
from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.choices import ModelName
from rdstitch.geometry.planar_motion import ABOUT_X, ABOUT_Y, nearest_in_plane, rigid_in_plane, rotation_from_tilt
from rdstitch.geometry.radial_homography import inverses

YAW, X, Y, LOG_HEIGHT, PSI, THETA = range(6)
"""Columns of a planar model's poses."""

_TILT_STARTS = np.array([(0.0, 0.0), (0.2, 0.0), (-0.2, 0.0), (0.0, 0.2), (0.0, -0.2)])
"""(ψ, θ), radians, away from what is known."""

_MAX_LOG_HEIGHT = 10.0  # where the model does not describe the motion, heights may diverge


class PlanarModel(MotionModel):
    """Camera that moves over a plane with a tilt that it keeps, or nearly keeps.

    Poses have six columns, :data:`YAW` to :data:`THETA`, of which only the free ones move; positions are multiplied by
    the focal length, tilts that are free divided by it. The shared parameters are ψ/f, θ/f and log f.
    """

    shared_names = ("psi", "theta", "log_focal")

    def __init__(self, name: ModelName, free: tuple[int, ...], *, any_tilt: bool = False) -> None:
        self.name, self.free, self.any_tilt = name, free, any_tilt
        self.pose_size, self.free_tilts, self.keeps_height = len(free), PSI in free, LOG_HEIGHT not in free

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
        growing = shared[:2] * focal + (tilts if self.free_tilts else 0.0)
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

    def shared_starts(self, log_focal: float, tilt: Sequence[float], *, tilt_known: bool) -> list[FloatArray]:
        """The tilt that is known; or none, and four around it."""
        steps = _TILT_STARTS[:1] if tilt_known else _TILT_STARTS
        return [self.shared_from_physical(np.array([*(np.array(tilt) + step), log_focal])) for step in steps]

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
        return poses[:, [PSI, THETA]] * (np.exp(shared[2]) if self.free_tilts else 1.0)

    def _tilted(self, tilts: FloatArray, shared: FloatArray) -> FloatArray:
        """Poses (N, 6) at the origin with tilts (N, 2) that differ by so much from the shared one, radians."""
        poses = np.zeros((len(tilts), 6))
        poses[:, [PSI, THETA]] = tilts / (np.exp(shared[2]) if self.free_tilts else 1.0)
        return poses

    def metric_poses(self, poses: FloatArray, shared: FloatArray) -> FloatArray:
        """Poses (N, 6) with positions in units of the height, and with the whole tilt, radians."""
        focal = np.exp(shared[2])
        result = poses.copy()
        result[:, [X, Y]] /= focal
        result[:, [PSI, THETA]] = self._tilts(poses, shared) + shared[:2] * focal
        return result

    def poses_from(
        self, other: MotionModel, poses: FloatArray, shared: FloatArray, attitudes: FloatArray
    ) -> FloatArray:
        """See the base class; poses of another planar model only change their units."""
        if not isinstance(other, PlanarModel):
            return super().poses_from(other, poses, shared, attitudes)
        result = poses.copy()
        result[:, [PSI, THETA]] = self._tilted(other._tilts(poses, shared), shared)[:, [PSI, THETA]]
        return result

    def nominal_homographies(self, shared: FloatArray, attitudes: FloatArray) -> FloatArray:
        """``diag(f, f, 1) R_i``."""
        poses = self._tilted(attitudes, shared)
        return self.matrices(poses, shared).matrices

    def nearest_poses(self, homographies: FloatArray, shared: FloatArray, attitudes: FloatArray) -> FloatArray:
        """The nearest poses, given how the tilts of the images differ from the shared one."""
        poses = self._tilted(attitudes, shared)
        motion = inverses(self.nominal_homographies(shared, attitudes)) @ homographies
        poses[:, YAW], translation, height = nearest_in_plane(motion)
        poses[:, [X, Y]] = translation * np.exp(shared[2])
        if LOG_HEIGHT in self.free:
            poses[:, LOG_HEIGHT] = np.log(np.clip(np.abs(height), 1e-3, 1e3))
        return poses

    def description(self, poses: FloatArray, shared: FloatArray) -> str:
        """What a fit says of the camera's height and tilt."""
        if self.keeps_height:
            return "height and tilt stay the same"
        heights = f"heights differ by {float(np.std(poses[:, LOG_HEIGHT])):.0%}"
        if not self.free_tilts:
            return f"{heights}, the tilt stays the same"
        tilts = self.metric_poses(poses, shared)[:, [PSI, THETA]]
        largest = math.degrees(float(np.arccos(np.cos(tilts).prod(axis=1)).max()))
        return f"{heights}, tilted by up to {largest:.0f} degrees"


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


RIGID = PlanarModel("rigid", (YAW, X, Y))
SIMILARITY = PlanarModel("similarity", (YAW, X, Y, LOG_HEIGHT))
TILTING = PlanarModel("tilting", (YAW, X, Y, LOG_HEIGHT, PSI, THETA))
POSE = PlanarModel("pose", (YAW, X, Y, LOG_HEIGHT, PSI, THETA), any_tilt=True)

PLANAR_MODELS = (RIGID, SIMILARITY, TILTING, POSE)
"""From the least to the most free."""
