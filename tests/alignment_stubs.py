"""Observations and fits made up for tests of decisions: nothing is adjusted, errors are as given."""

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.bundle_adjustment import BundleAdjustmentResult
from rdstitch.alignment.motion_models import MotionModel
from rdstitch.alignment.observations import Observations
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


def adjusted(
    seen: Observations, squared: FloatArray, *, lens: Sequence[float] = (0.0,) * 5, poses: Any = None, shared: Any = ()
) -> BundleAdjustmentResult:
    """A result with these squared errors (M,)."""
    sigma = float(np.sqrt(np.median(squared))) / 1.1774
    parameters = SimpleNamespace(
        lens=np.array(lens), poses=np.zeros((6, 6)) if poses is None else poses, shared=np.array(shared)
    )
    made: Any = SimpleNamespace(
        squared=squared, sigma=sigma, parameters=parameters, homographies=np.tile(SHIFT, (len(seen), 1, 1))
    )
    found: BundleAdjustmentResult = made
    return found


def _focal_cost(parameters: Any) -> float:
    """The last shared parameter is log f, known to be 0.2 ± 0.3 where a model has one."""
    return float(((parameters.shared[-1:] - 0.2) ** 2).sum() / 0.3**2)


def problem(seen: Observations, fits: Callable[[MotionModel], Fit], images: int = 6, **more: Any) -> Problem:
    """A problem whose fits are given; ``problem.fitted`` lists the models that were fitted."""
    fitted: list[str] = []

    def fit(model: MotionModel, *_: object, **__: object) -> Fit:
        fitted.append(model.name)
        return fits(model)

    made: Any = SimpleNamespace(
        observations=seen,
        homographies=np.tile(SHIFT, (len(seen), 1, 1)),
        lens=np.zeros(5),
        free_lens=ONLY_DISTORTION,
        count=images,
        fit=fit,
        fitted=fitted,
        extend=lambda fit, lens: fit,
        adjuster_of=lambda fit: SimpleNamespace(camera_prior_cost=_focal_cost),
        **more,
    )
    found: Problem = made
    return found
