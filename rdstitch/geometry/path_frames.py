"""Frames of reference of a path over the plane, and what poses and covariances are in them.

The plane lies at z = 0; at the first frame x, y and yaw are zero. Four frames of reference, all right-handed:

========= ============================================================= ==================
"enu"     x to the right and y to the top of the first image, z up      the camera above 0
"ros"     x to the top and y to the left of the first image, z up       the camera above 0
"camera"  x to the right and y to the bottom of the first image, z down the camera below 0
"first"   the same; a mosaic's sidecar and plane have it too            the camera below 0
========= ============================================================= ==================
"""

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.choices import TrajectoryFrame

AXES: dict[TrajectoryFrame, FloatArray] = {
    "enu": np.array([[1.0, 0.0], [0.0, -1.0]]),
    "camera": np.eye(2),
    "first": np.eye(2),
    "ros": np.array([[0.0, -1.0], [-1.0, 0.0]]),
}
"""x and y by those of the first image, to its right and its bottom."""

NOT_MEASURED = 1e6
"""Variance that programs of ROS take for "not measured"."""


def in_frame(x: float, y: float, frame: TrajectoryFrame) -> tuple[float, float]:
    """Coordinates x and y in a frame of reference, given in the axes of the first image."""
    there = AXES[frame] @ (x, y) + 0.0  # no minus zero
    return float(there[0]), float(there[1])


def covariance_in_frame(covariance: FloatArray, frame: TrajectoryFrame) -> FloatArray:
    """Covariances (..., 4, 4) of x, y, height and yaw in a frame of reference, given in the axes of the first image."""
    change = np.eye(4)
    change[:2, :2] = AXES[frame]
    return np.asarray(change @ covariance @ change.T)


def ros_covariance(covariance: FloatArray, frame: TrajectoryFrame) -> FloatArray:
    """Covariances (..., 6, 6) of x, y, z and the turns about these axes, radians, as messages of ROS have them.

    The tilt has been taken out of the poses: of the turns about x and y nothing is said.
    """
    known, place = covariance_in_frame(covariance, frame), np.array([0, 1, 2, 5])
    sign = -turn_about_z(frame)
    whole = np.zeros((*covariance.shape[:-2], 6, 6))
    whole[..., place[:, None], place] = known * np.outer([1.0, 1.0, sign, sign], [1.0, 1.0, sign, sign])
    whole[..., 3, 3] = whole[..., 4, 4] = NOT_MEASURED
    return whole


def turn_about_z(frame: TrajectoryFrame) -> float:
    """Sign of z down, and so of a turn about z against the yaw, in a frame of reference."""
    return float(np.linalg.det(AXES[frame]))
