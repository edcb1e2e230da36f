"""Poses of cameras for other programs: COLMAP's ``images.txt`` and OpenDroneMap's ``geo.txt``.

COLMAP's world has x to the east, y to the north and z up, in metres from a place that the first line tells, where the
output is georeferenced; else x to the right and y to the top of the plane, in heights of the reference image. Its
quaternions and translations lead from there to a camera with x to the right, y down and z ahead; camera 1 is that of
``--save-camera cameras.txt``.
"""

from collections.abc import Sequence

import numpy as np

from rdstitch.alignment.result import PlanarPoses
from rdstitch.arrays import FloatArray
from rdstitch.geometry.planar_motion import rigid_in_plane, rotation_from_tilt
from rdstitch.system.late_imports import spatial


def images_of_colmap(names: Sequence[str], poses: PlanarPoses, to_map: FloatArray | None) -> str:
    """The text of ``images.txt``, without points; ``to_map`` (2, 3) leads from the plane, y down, to the map."""
    to_world = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]) if to_map is None else to_map
    unit = float(np.hypot(to_world[0, 0], to_world[1, 0]))
    known = np.flatnonzero(np.isfinite(poses.yaw))
    centres = _on_map(poses, to_world)[known]
    origin = np.zeros(3) if to_map is None else np.append(np.floor(centres[:, :2].mean(axis=0)), 0.0)
    # The plane's z is down.
    axes = np.eye(3)
    axes[:2, :2], axes[2, 2] = to_world[:, :2] / unit, -1.0
    lines = ["# origin (east, north, up): {:.0f} {:.0f} {:.0f}".format(*origin)]
    for number, (k, centre) in enumerate(zip(known.tolist(), centres - origin, strict=True), start=1):
        rotation = rotation_from_tilt(poses.tilt[k]) @ rigid_in_plane(poses.yaw[k], np.zeros(2)) @ axes.T
        x, y, z, w = spatial.transform.Rotation.from_matrix(rotation).as_quat().tolist()
        values = " ".join(f"{value:.10g}" for value in (w, x, y, z, *(-rotation @ centre).tolist()))
        lines += [f"{number} {values} 1 {names[k]}", ""]
    return "\n".join(lines) + "\n"


def geo_of_opendronemap(names: Sequence[str], poses: PlanarPoses, to_map: FloatArray, epsg: int, ground: float) -> str:
    """The text of ``geo.txt``: easting, northing and altitude of each camera; the ground is at an altitude, m."""
    centres = _on_map(poses, to_map) + np.array([0.0, 0.0, ground])
    known = np.flatnonzero(np.isfinite(poses.yaw)).tolist()
    rows = ["{} {:.4f} {:.4f} {:.4f}".format(names[k], *centres[k]) for k in known]
    return "\n".join([f"EPSG:{epsg}", *rows]) + "\n"


def _on_map(poses: PlanarPoses, to_map: FloatArray) -> FloatArray:
    """East, north and height (N, 3) of the cameras."""
    unit = float(np.hypot(to_map[0, 0], to_map[1, 0]))
    places = poses.position @ to_map[:, :2].T + to_map[:, 2]
    return np.concatenate([places, poses.height[:, None] * unit], axis=1)
