"""The image whose undistorted coordinates are the plane, and how a plane stretches others."""

from dataclasses import replace

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit
from rdstitch.alignment.least_squares.link_equations import split_lens
from rdstitch.alignment.result import Alignment
from rdstitch.arrays import FloatArray
from rdstitch.geometry.division_model import undistort
from rdstitch.geometry.radial_homography import inverses

_POINTS_PER_SIDE = 8
_REFERENCES_AT_ONCE = 32

MAX_STRETCH = 10.0
"""Ratio of areas from which on a layout is not believed. A plane seen from above has up to 7, one seen under 35 degrees
6 to 15, by the focal length."""


_GRID = np.stack(np.meshgrid([-0.8, 0.0, 0.8], [-0.6, 0.0, 0.6]), axis=-1).reshape(-1, 2)
"""Half diagonals: points of an image of usual proportions, out to the corners."""

_FRAMES = 12  # images that are tried as the frame of a plane without a metric


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
    """Smallest third coordinate of borders (N, P, 3), in units of the largest, in frames (R, 3, 3), shape (N, R)."""
    third = borders @ np.linalg.inv(references)[:, 2].T
    return np.asarray(third.min(axis=1) / np.abs(third).max(axis=1))


def stretch(fit: Fit) -> float:
    """Return the ratio of the areas that a pixel gets, 98 % over 2 % of all images; inf where they are folded.

    On a sphere every direction has the same room. A plane that has no metric is seen as the image shows it that does so
    best.
    """
    if fit.model.on_sphere:
        return 1.0
    distortion, higher, center = split_lens(fit.result.parameters.lens)
    undistorted = undistort(_GRID - center, distortion, higher)
    rays = np.column_stack([undistorted, np.ones(len(_GRID))])
    matrices = fit.result.matrices.matrices
    to_plane = inverses(matrices)
    if fit.model.one_camera:
        return _ratio(rays, to_plane)
    return min(_ratio(rays, frame @ to_plane) for frame in matrices[:: -(-len(matrices) // _FRAMES)])


def _ratio(rays: FloatArray, to_plane: FloatArray) -> float:
    """Ratio of the areas around rays (P, 3) of all images, whose homographies are (N, 3, 3)."""
    depth = rays @ to_plane[:, 2].T
    with np.errstate(all="ignore"):
        areas = np.abs(np.linalg.det(to_plane)) / depth**3
    low, high = np.quantile(np.where(areas > 0.0, areas, np.inf), [0.02, 0.98], method="nearest")
    return float(high / low) if np.isfinite(low) else np.inf
