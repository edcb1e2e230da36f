"""The undistorted reference image as the plane that all images are mapped to, and which image suits that."""

from dataclasses import replace

import numpy as np

from rdstitch.alignment.layout import MAX_STRETCH
from rdstitch.alignment.result import Alignment, PlanarPoses
from rdstitch.arrays import FloatArray, IntArray

_POINTS_PER_SIDE = 8


def in_frame_of(alignment: Alignment, reference: int) -> Alignment:
    """The same alignment with the undistorted image ``reference`` as its plane, and its height as unit of poses."""
    homographies = np.linalg.inv(alignment.homographies[reference]) @ alignment.homographies
    poses = alignment.poses
    if poses is not None and reference != alignment.reference:
        c, s = np.cos(poses.yaw[reference]), np.sin(poses.yaw[reference])
        unit = poses.height[reference]
        position = (poses.position - poses.position[reference]) @ np.array([[c, -s], [s, c]]).T / unit
        yaw = np.remainder(poses.yaw - poses.yaw[reference] + np.pi, 2.0 * np.pi) - np.pi
        poses = PlanarPoses(yaw, position, poses.height / unit, poses.tilt)
    return replace(alignment, homographies=homographies, reference=reference, poses=poses)


def frontal_reference(alignment: Alignment) -> int:
    """The reference image, or, where another one is absurdly stretched by its frame, the one that stretches least."""
    used = np.flatnonzero(alignment.used)
    nearness = np.array([_nearest_to_horizon(alignment, used, int(k)) for k in used])
    own = int(np.flatnonzero(used == alignment.reference)[0])
    if nearness[own].min() > MAX_STRETCH ** (-1.0 / 3.0):  # areas grow with the third power
        return alignment.reference
    crossing, least = (nearness <= 0.0).sum(axis=1), nearness.min(axis=1)
    return int(used[np.lexsort((-least, crossing))[0]])


def _nearest_to_horizon(alignment: Alignment, used: IntArray, reference: int) -> FloatArray:
    """Smallest third coordinate of each image's border in the frame of ``reference``, in units of the largest."""
    values = []
    for index in used:
        camera, relation = alignment.cameras[index], alignment.relation(int(index), reference)
        flat = camera.normalize(camera.undistort(camera.outline(_POINTS_PER_SIDE)))
        third = flat @ relation[2, :2] + relation[2, 2]
        values.append(float(third.min() / np.abs(third).max()))
    return np.array(values)
