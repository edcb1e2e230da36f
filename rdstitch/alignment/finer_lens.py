"""ν where all pictures together show it: pairs alone hardly do, and leave strong fisheyes a tenth of a pixel off.

Only where the errors are noise. Over relief a motion model would take ν for the ground, as it would μ.
"""

from dataclasses import replace

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.lens_selection import (
    ENOUGH_PICTURES,
    NO_COHERENCE,
    free_parameters,
    has_plausible_center,
)
from rdstitch.alignment.noise_model import NoiseModel
from rdstitch.alignment.normal_equations import whitened_errors
from rdstitch.alignment.planarity import coherence
from rdstitch.robust.loss import ALIGNMENT_WIDTH

_MIN_GAIN = 1.0
"""Squared standard deviations that ν must gain: less than Akaike's criterion asks for, since the noise model takes the
points of all links of a picture for the same, of which each link uses others."""


def with_third_coefficient(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """A problem and its fit, with ν free where that is worth it, and μ and the centre are free."""
    adjusted, observations, finer = fit.adjusted, problem.observations, free_parameters("division3")
    if problem.count < ENOUGH_PICTURES or (fit.free_lens != free_parameters("division2")).any():
        return problem, fit
    errors = whitened_errors(observations, adjusted.homographies, adjusted.parameters.lens)
    inliers = adjusted.squared <= (ALIGNMENT_WIDTH * adjusted.sigma) ** 2
    if coherence(observations, errors, inliers).correlation > NO_COHERENCE:
        return problem, fit
    wider = problem.extend(fit, finer)
    noise = NoiseModel.of_errors(observations, errors)
    gain = float((noise.misfit(adjusted.squared) - noise.misfit(wider.adjusted.squared)).sum())
    if gain <= _MIN_GAIN or not has_plausible_center(wider.adjusted, observations):
        return problem, fit
    return replace(problem, free_lens=finer), wider
