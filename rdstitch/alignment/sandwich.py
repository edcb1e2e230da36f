"""How well λ is known where errors are no independent noise: a sandwich estimate over blocks (Liang and Zeger 1986).

Relief moves all points of a place on the ground together, in every pair of pictures that shows it; a lens that one
model does not quite describe, or a rolling shutter, moves all points of a picture. The inverse of the normal equations
takes errors for independent and is too small then. Here the influence of each correspondence on λ is added up per
block, within which errors may do what they like, and the sums are squared.

Blocks cannot see what the parameters have absorbed: hills as wide as an overlap are fitted by its homography and by λ.
What neighbours have in common is therefore taken to be as large where nothing shows it, and counts as half an
independent observation of λ for each pair of pictures.
"""

from dataclasses import replace

import numpy as np

from rdstitch.alignment.bundle_adjustment import BundleAdjuster, BundleAdjustmentResult
from rdstitch.alignment.link_equations import whitened_errors
from rdstitch.alignment.motion_models import inverses
from rdstitch.alignment.observations import Observations
from rdstitch.alignment.planarity import coherence
from rdstitch.arrays import FloatArray, IntArray
from rdstitch.division_model import undistort
from rdstitch.radial_homography import project
from rdstitch.robust.loss import ALIGNMENT_WIDTH, robust_weight

_STEP = 1e-3
"""Of the direction along which the errors are differentiated, in standard deviations of λ."""

_OBSERVATIONS_PER_LINK = 0.5
"""Independent observations of λ by one link, of errors that neighbours have in common. Chosen on windows of real
flights, where ``python -m tests.benchmarks.coverage`` prints a median error of 0.7 σ; over rendered relief, where
``python -m tests.benchmarks.relief`` prints about 0.4 σ, it is on the safe side."""

_CELLS_PER_PICTURE, _MOST_CELLS = 3, 10_000
"""Blocks of ground along a side of a picture; and on each side of the middle, beyond which all are one."""


def sandwich_std(adjuster: BundleAdjuster, adjusted: BundleAdjustmentResult) -> float:
    """Standard deviation of λ when errors agree within blocks of ground, or within pictures, whichever is larger.

    Parameters
    ----------
    adjuster : BundleAdjuster
        With λ free.
    adjusted : BundleAdjustmentResult
        Of this adjuster.
    """
    influence = _influence(adjuster, adjusted)
    ground = _ground_blocks(adjuster.observations, adjusted)
    by_ground = float((np.bincount(ground, influence) ** 2).sum())
    blocks = len(np.unique(ground[influence != 0.0]))
    free = int(adjuster.free.poses.sum()) + len(adjusted.parameters.shared) + int(adjuster.free.lens.sum())
    few = 2.0 * blocks / max(2.0 * blocks - free, 0.25 * blocks)  # what the parameters have absorbed
    blockwise = max(by_ground * few, _by_pictures(adjuster.observations, influence))
    return float(np.sqrt(blockwise + _absorbed(adjuster, adjusted, influence)))


def _influence(adjuster: BundleAdjuster, adjusted: BundleAdjustmentResult) -> FloatArray:
    """By how much each correspondence moves λ, shape (M,)."""
    normal, observations = adjuster.normal_equations(adjusted), adjuster.observations
    unit = np.zeros(len(normal.gradient_shared))
    unit[len(adjusted.parameters.shared)] = -1.0
    poses, shared = replace(normal, gradient_poses=np.zeros_like(normal.gradient_poses), gradient_shared=unit).solve(
        1e-12
    )
    step = np.zeros(adjuster.free.poses.shape)
    step[adjuster.free.poses] = poses
    size = _STEP / max(float(np.sqrt(abs(shared[len(adjusted.parameters.shared)]))), 1e-12)
    ahead, behind = (_errors(adjuster, adjusted, sign * size * step, sign * size * shared) for sign in (1.0, -1.0))
    errors = whitened_errors(observations, adjusted.homographies, adjusted.parameters.lens)
    weight = robust_weight(adjusted.squared, ALIGNMENT_WIDTH * adjusted.sigma) * adjuster.weight(adjusted.sigma)
    change = (ahead - behind) / (2.0 * size)
    influence: FloatArray = np.nan_to_num(weight * np.einsum("mi,mi->m", errors, change))
    return influence


def _errors(
    adjuster: BundleAdjuster, adjusted: BundleAdjustmentResult, poses: FloatArray, shared: FloatArray
) -> FloatArray:
    """Whitened errors (M, 2) after a step."""
    moved = adjusted.parameters.retract(adjuster.model, poses, shared, adjuster.free.lens)
    matrices = adjuster.model.matrices(moved.poses, moved.shared).matrices
    i, j = adjuster.observations.image1, adjuster.observations.image2
    return whitened_errors(adjuster.observations, matrices[j] @ inverses(matrices)[i], moved.lens)


def _absorbed(adjuster: BundleAdjuster, adjusted: BundleAdjustmentResult, influence: FloatArray) -> float:
    """Variance of λ by what neighbours have in common, as far as the parameters can have absorbed it."""
    errors = whitened_errors(adjuster.observations, adjusted.homographies, adjusted.parameters.lens)
    inliers = adjusted.squared <= (ALIGNMENT_WIDTH * adjusted.sigma) ** 2
    common = max(coherence(adjuster.observations, errors, inliers).correlation, 0.0)
    independent = _OBSERVATIONS_PER_LINK * len(adjuster.observations)
    return common * float((influence**2).sum()) * max(2.0 * float(inliers.sum()) / independent, 1.0)


def _ground_blocks(observations: Observations, adjusted: BundleAdjustmentResult) -> IntArray:
    """The block of ground of each correspondence, shape (M,)."""
    lens, link = adjusted.parameters.lens, observations.link
    flat = undistort(observations.points1 - lens[-2:], float(lens[0]), tuple(lens[1:-2].tolist()))
    # One coordinate after the other: a matrix for each correspondence would be most of the memory of an alignment.
    back = np.moveaxis(inverses(adjusted.matrices.matrices)[observations.image1], 0, -1)
    plane = [row[0][link] * flat[:, 0] + row[1][link] * flat[:, 1] + row[2][link] for row in back]
    first = np.nan_to_num(project(np.column_stack(plane)))
    starts = observations.start[:-1][np.diff(observations.start) > 0]
    sizes = np.maximum.reduceat(first, starts) - np.minimum.reduceat(first, starts)
    side = max(float(np.median(sizes.max(axis=1))), 1e-12) / _CELLS_PER_PICTURE
    column, row = np.clip(np.floor((first - np.median(first, axis=0)) / side), -_MOST_CELLS, _MOST_CELLS).T
    number: IntArray = np.unique(column * (2 * _MOST_CELLS + 1) + row, return_inverse=True)[1]
    return number


def _by_pictures(observations: Observations, influence: FloatArray) -> float:
    """Variance when errors of links that share a picture agree (dyadic clusters; Aronow, Samii, Assenova 2015)."""
    link = np.bincount(observations.link, influence, len(observations))
    count = 1 + int(max(observations.image1.max(), observations.image2.max()))
    picture = np.bincount(observations.image1, link, count) + np.bincount(observations.image2, link, count)
    return max(float((picture**2).sum() - (link**2).sum()), 0.0)
