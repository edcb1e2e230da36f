"""Observations and fits made up for tests of decisions: nothing is adjusted, errors are as given."""

from collections.abc import Sequence

import numpy as np

from rdstitch.alignment.least_squares.bundle_adjustment import (
    BundleAdjuster,
    BundleAdjustmentResult,
    FreeParameters,
    Parameters,
)
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.least_squares.priors import Priors
from rdstitch.alignment.motion_models import HOMOGRAPHY
from rdstitch.arrays import FloatArray

SCALE = 500.0
"""Half diagonals of all images, pixels."""

SHIFT = np.array([[1.0, 0.0, 0.1], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
"""The homography of every link; without any motion links would count as static."""

ONLY_DISTORTION = np.array([True, False, False, False, False])


def observations(errors: FloatArray, images: int = 6) -> Observations:
    """Links of neighbours and of next but one, whose errors under :data:`SHIFT` are (L, K, 2), pixels."""
    links, each = errors.shape[:2]
    pairs = [(i, i + step) for step in range(1, images) for i in range(images - step)][:links]
    first, second = np.array(pairs, dtype=np.intp).T
    points = np.random.default_rng(7).uniform(-0.6, 0.6, (links * each, 2))
    start = np.arange(0, links * each + 1, each, dtype=np.intp)
    size, moved = np.full(links, SCALE), points + SHIFT[:2, 2] - errors.reshape(-1, 2) / SCALE
    return Observations(first, second, start, points, moved, size, size, np.full(links, each, dtype=np.intp))


def independent_errors(links: int = 9, each: int = 60, sigma: float = 0.5) -> FloatArray:
    return np.random.default_rng(3).normal(0.0, sigma, (links, each, 2))


def adjusted(seen: Observations, squared: FloatArray, *, lens: Sequence[float] = (0.0,) * 5) -> BundleAdjustmentResult:
    """A result with these squared errors (M,)."""
    freedom = FreeParameters.fixing(HOMOGRAPHY, 0, [], ONLY_DISTORTION)
    adjuster = BundleAdjuster(HOMOGRAPHY, seen, freedom, Priors.none(HOMOGRAPHY, 0))
    parameters = Parameters(np.empty((0, 9)), np.empty(0), np.array(lens))
    made = BundleAdjustmentResult(adjuster, parameters, float(np.sqrt(np.median(squared))) / 1.1774, True, 1)
    vars(made).update(squared=squared, homographies=np.tile(SHIFT, (len(seen), 1, 1)))
    return made
