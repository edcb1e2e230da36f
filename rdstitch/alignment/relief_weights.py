"""Over rough ground an error along the parallax says little of the camera, one across it as much as over a plane.

The height of a place moves it in one image against the other along the line between the cameras, and along that alone
(plane and parallax; Kumar, Anandan and Hanna 1994). So heights are taken for random: their scatter is found from how
much larger errors are along the parallax than across it, and the covariance of an error is that of the noise and of the
heights together. Without that, a camera bends the strip, tilts and takes an odd focal length to follow hills.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.least_squares.link_equations import linearized_errors
from rdstitch.alignment.lens.lens_selection import residual_coherence
from rdstitch.alignment.motion_models import SIMILARITY, TILTING
from rdstitch.alignment.noise import independent_errors, shows_relief
from rdstitch.alignment.parallax import Parallax
from rdstitch.alignment.select import ModelChoice, best_of
from rdstitch.alignment.starts import fit_model, start_from
from rdstitch.arrays import FloatArray
from rdstitch.choices import ModelName, Purpose
from rdstitch.numerics.robust_loss import NORMAL_MEDIAN

_MIN_IMAGES = 3  # images: of two, tilts do what heights do, and the errors do not show which

_ROUNDS = 4
"""Rounds of finding the scatter of the heights and adjusting again: at first the camera has followed the hills, so that
it is found too small."""

_SETTLED = 0.02  # relative change of that scatter that is none
_SQUARE_MEDIAN = NORMAL_MEDIAN**2  # median of the square of a normal variable of variance 1
_MEDIAN_STD = 2.333  # standard deviation of the median of N such squares, in medians and times the root of N

_SIGNIFICANT = 3.0
"""Standard deviations of the logarithm of their ratio by which errors along the parallax must exceed those across."""


def choose_over_relief(
    problem: Problem, choice: ModelChoice, names: Sequence[ModelName], purpose: Purpose
) -> ModelChoice:
    """The model of one camera chosen again, with heights that account for errors, where such heights show.

    Freeing the distortion centre is not tried: over relief it bends the whole as the ground bends the images.
    """
    # Where neighbours hardly agree, errors along the parallax are none of the ground: blobs have them, seen obliquely.
    if not shows_relief(residual_coherence(choice.fit.result)) or weighted_by_relief(problem, choice.fit) is None:
        return choice
    problem = replace(problem, overdispersion=choice.fit.overdispersion)
    fits: list[Fit] = []
    # From the least free one: a camera that is free to tilt has already followed the hills.
    for model in (SIMILARITY, TILTING):
        if model.name in names and not choice.fit.model.any_tilt:
            start = problem.refine(model, start_from(problem, model, fits[-1])) if fits else fit_model(problem, model)
            problem, fit = _settled(problem, start)
            fits.append(fit)
    if not fits:
        return replace(choice, fit=_settled(problem, choice.fit)[1], over_relief=True)
    refined = [_refined(problem, fit) for fit in fits]
    best = best_of(problem, refined, purpose, requested=len(names) == 1)
    return choice if best is None else replace(best, over_relief=True)


def adjust_over_relief(problem: Problem, choice: ModelChoice) -> tuple[Problem, Fit]:
    """The chosen fit adjusted to a problem with more observations, and the problem with what heights do to these."""
    if choice.over_relief:
        return _settled(problem, choice.fit)
    return problem, _refined(problem, choice.fit)


def weighted_by_relief(problem: Problem, fit: Fit) -> Problem | None:
    """The problem with what heights add to the covariances of its errors; None where no heights show.

    Of one camera over a plane only.
    """
    if not fit.model.has_metric_poses or problem.count < _MIN_IMAGES:
        return None
    plain = replace(problem, observations=replace(problem.observations, relief=None))
    adjuster, adjusted, o = plain.adjuster_of(fit), fit.result, plain.observations
    field = Parallax(adjuster, adjusted)
    errors, parallax, moved = (np.zeros_like(o.points1) for _ in range(3))
    for part in linearized_errors(o, adjusted.homographies, adjusted.parameters.lens, adjuster.free.lens):
        errors[part.rows], parallax[part.rows] = part.errors, field.of(part)[1]
        seen = part.by_point2[:, 0, 0] != 0.0
        # Without the whitening, in half diagonals of the second image.
        moved[part.rows][seen] = np.linalg.solve(-part.by_point2[seen], parallax[part.rows][seen, :, None])[:, :, 0]
    scatter = _scatter(errors, parallax, independent_errors(o, plain.homographies, plain.lens)[1])
    if scatter == 0.0:
        return None
    return replace(problem, observations=replace(o, relief=scatter * moved * o.scale2[o.link, None]))


def _settled(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """A problem and a fit that go with each other."""
    size = math.inf
    for _ in range(_ROUNDS):
        flat = replace(problem, observations=replace(problem.observations, relief=None))
        problem = weighted_by_relief(problem, fit) or flat
        fit = _refined(problem, fit)
        relief, former = problem.observations.relief, size
        size = 0.0 if relief is None else float(np.median(np.linalg.norm(relief, axis=1)))
        if abs(size - former) <= _SETTLED * size:
            break
    return problem, fit


def _refined(problem: Problem, fit: Fit) -> Fit:
    return problem.refine(fit.model, fit.result.parameters, fit.tilt_spread)


def _scatter(errors: FloatArray, parallax: FloatArray, effective: float) -> float:
    """Standard deviation of the heights over that of the noise, in units per pixel; 0 where none is significant.

    By whitened errors (M, 2), pixels, those of ground one unit higher, and the number of independent coordinates.
    """
    length = np.linalg.norm(parallax, axis=1)
    moving = length > 0.0
    length, errors = length[moving], errors[moving]
    direction = parallax[moving] / length[:, None]
    along = np.einsum("mi,mi->m", errors, direction) ** 2
    across = (errors[:, 1] * direction[:, 0] - errors[:, 0] * direction[:, 1]) ** 2
    noise = float(np.median(across)) / _SQUARE_MEDIAN if len(across) else 0.0
    min_ratio = math.exp(_SIGNIFICANT * _MEDIAN_STD * math.sqrt(2.0 / (effective / 2.0)))
    if noise <= 0.0 or float(np.median(along)) <= min_ratio * noise * _SQUARE_MEDIAN:
        return 0.0
    # Of this scatter the median of ``along / (noise + (scatter length)²)`` is what it is for normal variables.
    variance = float(np.median((along / _SQUARE_MEDIAN - noise) / length**2))
    return math.sqrt(max(variance, 0.0) / noise)
