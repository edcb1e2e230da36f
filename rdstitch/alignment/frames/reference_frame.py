"""The image whose undistorted coordinates are the plane."""

from dataclasses import replace

import numpy as np

from rdstitch.alignment.result import Alignment
from rdstitch.arrays import FloatArray

_POINTS_PER_SIDE = 8
_REFERENCES_AT_ONCE = 32

MAX_STRETCH = 10.0
"""Ratio of areas from which on a layout is not believed. A plane seen from above has up to 7, one seen under 35 degrees
6 to 15, by the focal length."""


def in_frame_of(alignment: Alignment, reference: int) -> Alignment:
    """The same alignment with the undistorted image ``reference`` as its plane, and its height as unit of poses."""
    homographies = np.linalg.inv(alignment.homographies[reference]) @ alignment.homographies
    poses, lever = alignment.poses, alignment.lever_std
    if poses is not None and reference != alignment.reference:
        poses, lever = poses.relative_to(reference), lever / float(poses.height[reference])
    return replace(alignment, homographies=homographies, reference=reference, poses=poses, lever_std=lever)


def frontal_reference(alignment: Alignment) -> int:
    """The reference image, or, where its frame stretches another out of proportion, the one that stretches least."""
    used = np.flatnonzero(alignment.used)
    borders = np.stack([_border_on_plane(alignment, int(k)) for k in used])
    present = _nearest_to_horizon(borders, alignment.homographies[[alignment.reference]])
    if present.min() > MAX_STRETCH ** (-1.0 / 3.0):  # areas grow with the third power
        return alignment.reference
    crossing, nearest = np.empty(len(used)), np.empty(len(used))
    for start in range(0, len(used), _REFERENCES_AT_ONCE):
        part = slice(start, start + _REFERENCES_AT_ONCE)
        nearness = _nearest_to_horizon(borders, alignment.homographies[used[part]])
        crossing[part], nearest[part] = (nearness <= 0.0).sum(axis=0), nearness.min(axis=0)
    return int(used[np.lexsort((-nearest, crossing))[0]])


def _border_on_plane(alignment: Alignment, image: int) -> FloatArray:
    """The border of an image on the plane, homogeneous (P, 3)."""
    camera = alignment.cameras[image]
    flat = camera.normalize(camera.undistort(camera.outline(_POINTS_PER_SIDE)))
    return np.asarray(np.column_stack([flat, np.ones(len(flat))]) @ alignment.homographies[image].T)


def _nearest_to_horizon(borders: FloatArray, references: FloatArray) -> FloatArray:
    """Smallest third coordinate of the borders (N, P, 3), in units of the largest, in frames of references (R, 3, 3).

    Shape (N, R).
    """
    third = borders @ np.linalg.inv(references)[:, 2].T
    return np.asarray(third.min(axis=1) / np.abs(third).max(axis=1))
