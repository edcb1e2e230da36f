"""Minimal solvers: all homographies and λ that a few point matches allow.

Which one when, with the number of matches that it needs:

================================  =  ============================================================
:func:`two_point`                 2  planar motion, tilt known (a levelled camera, an IMU, a gimbal)
:func:`three_point`               3  planar motion, tilt unknown: the minimal case
:func:`three_point_similarity`    3  planar motion whose height changes (a drone), tilt known
:func:`four_point`                4  planar motion, tilt unknown, by a constraint on the homography
:func:`five_point`                5  any motion and any plane; the only one without a focal length
:func:`rotation_two_point`        2  rotation about the camera's centre, focal length known
:func:`two_point_rigid`           2  λ known: planar motion, tilt known
:func:`two_point_similarity`      2  λ known: planar motion whose height changes, tilt known
:func:`four_point_dlt`            4  λ known: any motion and any plane
:func:`rotation_two_point_focal`  2  λ known: rotation, which gives the focal length
================================  =  ============================================================

All take batches of samples, (B, k, 2), and return every real solution; see :class:`Solutions`. They raise
:exc:`rdstitch.errors.ArgumentError` when a shape is wrong or a range is empty.
"""

from rdstitch.solvers.five_point import five_point
from rdstitch.solvers.four_point import four_point
from rdstitch.solvers.known_distortion import four_point_dlt, two_point_rigid, two_point_similarity
from rdstitch.solvers.rotation_two_point import rotation_two_point
from rdstitch.solvers.rotation_two_point_focal import rotation_two_point_focal
from rdstitch.solvers.solutions import Solutions
from rdstitch.solvers.three_point import three_point
from rdstitch.solvers.three_point_similarity import three_point_similarity
from rdstitch.solvers.two_point import two_point

__all__ = [
    "Solutions",
    "five_point",
    "four_point",
    "four_point_dlt",
    "rotation_two_point",
    "rotation_two_point_focal",
    "three_point",
    "three_point_similarity",
    "two_point",
    "two_point_rigid",
    "two_point_similarity",
]
