"""Any motion of any camera: one homography per image."""

from collections.abc import Sequence

import numpy as np

from rdstitch.alignment.motion_models.base import ModelMatrices, MotionModel
from rdstitch.arrays import FloatArray

_TRACELESS = np.zeros((8, 3, 3))
_TRACELESS[[0, 1, 2, 3, 4, 5], [0, 0, 1, 1, 2, 2], [1, 2, 0, 2, 0, 1]] = 1.0
_TRACELESS[6] = np.diag([1.0, -1.0, 0.0]) / np.sqrt(2.0)
_TRACELESS[7] = np.diag([1.0, 1.0, -2.0]) / np.sqrt(6.0)


class HomographyModel(MotionModel):
    """One homography per image: eight parameters, a step being ``P ← exp(Σ δ_k E_k) P``.

    The step acts in the image's frame, where coordinates are of order one however far away the image lies. ``E_k``
    span the matrices without trace: only so does a change of the plane's frame, ``P M P⁻¹`` in every image, leave
    all relations of images as they are, to any order. Poses are P, row by row.
    """

    name, pose_size, one_camera = "homography", 8, False

    def matrices(self, poses: FloatArray, shared: FloatArray) -> ModelMatrices:
        """Homographies from the plane to the images, with derivatives."""
        matrices = poses.reshape(-1, 3, 3)
        return ModelMatrices(matrices, _TRACELESS @ matrices[:, None], np.zeros((len(poses), 0, 3, 3)))

    def shared_starts(self, log_focal: float, tilt: Sequence[float], *, tilt_known: bool) -> list[FloatArray]:
        """Nothing to try."""
        return [np.zeros(0)]

    def retract(self, poses: FloatArray, step: FloatArray) -> FloatArray:
        """Poses after a step of shape (N, 8)."""
        change = np.einsum("nk,kij->nij", step, _TRACELESS)
        growth = np.eye(3) + change @ (np.eye(3) + change / 2.0)  # exp to second order
        return _unit_determinant(growth @ poses.reshape(-1, 3, 3))

    def nominal_homographies(self, shared: FloatArray, attitudes: FloatArray) -> FloatArray:
        """The identity."""
        return np.tile(np.eye(3), (len(attitudes), 1, 1))

    def nearest_poses(self, homographies: FloatArray, shared: FloatArray, attitudes: FloatArray) -> FloatArray:
        """The homographies themselves."""
        return _unit_determinant(homographies)

    def description(self, poses: FloatArray, shared: FloatArray) -> str:
        """What free homographies say of the camera."""
        return "no camera with one focal length explains the images" if len(poses) > 2 else "two images need no more"


def _unit_determinant(matrices: FloatArray) -> FloatArray:
    """Scaled to determinant ±1 without changing sign, flattened to (N, 9)."""
    size = np.cbrt(np.maximum(np.abs(np.linalg.det(matrices)), 1e-300))
    scaled: FloatArray = matrices / size[:, None, None]
    return scaled.reshape(-1, 9)


HOMOGRAPHY = HomographyModel()
