"""A camera that turns on the spot, as a motion model: ``P_i = diag(f, f, 1) R_i`` from directions to the image.

Two images are related by ``H_ij = P_j P_i⁻¹ = K R_j R_i' K⁻¹`` in all directions: no plane is needed, and there is
no horizon, so that a full circle closes. A step turns the camera in its own frame, ``R ← exp([δ]x) R``.
"""

import math
from collections.abc import Sequence

import numpy as np

from rdstitch.alignment.motion_models.base import ModelMatrices, MotionModel
from rdstitch.arrays import FloatArray
from rdstitch.geometry.planar_motion import ABOUT_X, ABOUT_Y, ABOUT_Z, nearest_rotation, rotation_about

_FOCAL_STARTS = tuple(math.log(focal) for focal in (0.6, 0.9, 1.4, 2.2, 3.6, 6.0))
"""Logarithms of focal lengths in half diagonals: from fisheyes to long lenses, near enough to each other that the
adjustment of pairs converges from the nearest."""

_MAX_STEP = 0.5  # radians; where the motion is no rotation, steps may diverge
_LOG_FOCAL_LIMITS = math.log(0.2), math.log(50.0)

_CROSS = np.stack([ABOUT_X, ABOUT_Y, ABOUT_Z])


class RotationModel(MotionModel):
    """Camera that turns about its centre.

    Poses are R, row by row, from the common frame of directions to the camera; the shared parameter is log f, f in
    half diagonals.
    """

    name, pose_size, shared_names, on_sphere = "rotation", 3, ("log_focal",), True

    def matrices(self, poses: FloatArray, shared: FloatArray) -> ModelMatrices:
        """Matrices from directions to the images, with derivatives."""
        rotations = poses.reshape(-1, 3, 3)
        focal = self.focal(shared)
        scale = np.array([[focal], [focal], [1.0]])
        matrices = scale * rotations
        by_pose = scale * (_CROSS @ rotations[:, None])
        by_focal = np.array([[focal], [focal], [0.0]]) * rotations
        return ModelMatrices(matrices, by_pose, by_focal[:, None])

    def shared_starts(self, log_focal: float, tilt: Sequence[float], *, tilt_known: bool) -> list[FloatArray]:
        """The focal length that is known, and a range of others."""
        return [np.array([each]) for each in (log_focal, *_FOCAL_STARTS)]

    def log_focal(self, shared: FloatArray) -> float:
        """Logarithm of the focal length, within what a lens can have."""
        return float(np.clip(shared[0], *_LOG_FOCAL_LIMITS))

    def retract(self, poses: FloatArray, step: FloatArray) -> FloatArray:
        """Poses after a step of shape (N, 3), radians."""
        turned: FloatArray = rotation_from_vector(step) @ poses.reshape(-1, 3, 3)
        return turned.reshape(-1, 9)

    def nominal_homographies(self, shared: FloatArray, attitudes: FloatArray) -> FloatArray:
        """``diag(f, f, 1)``."""
        focal = self.focal(shared)
        return np.tile(np.diag([focal, focal, 1.0]), (len(attitudes), 1, 1))

    def nearest_poses(self, homographies: FloatArray, shared: FloatArray, attitudes: FloatArray) -> FloatArray:
        """The nearest rotations."""
        focal = self.focal(shared)
        matrices = homographies / np.array([[focal], [focal], [1.0]])
        matrices = matrices * np.sign(np.linalg.det(matrices))[:, None, None]
        return nearest_rotation(matrices).reshape(-1, 9)

    def description(self, poses: FloatArray, shared: FloatArray) -> str:
        """What a turn says of the camera."""
        return "the camera turned on the spot"


def rotation_from_vector(vectors: FloatArray) -> FloatArray:
    """Rotations (N, 3, 3) about axes (N, 3) by their length, radians (Rodrigues); long ones are shortened."""
    angle = np.linalg.norm(vectors, axis=1)
    return rotation_about(vectors * np.minimum(1.0, _MAX_STEP / np.maximum(angle, 1e-300))[:, None])


ROTATION = RotationModel()
