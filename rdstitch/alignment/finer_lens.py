"""ν where all images together may show it: pairs alone hardly do, and leave strong fisheyes a tenth of a pixel off.

A lens that needs μ is a series that was cut off, so that its next term is not zero and needs no proof: freed where it
is smaller than its standard deviation it costs next to nothing, and left out where it is not it bends the image. Only
where the errors are noise. Over relief a motion model would take ν for the ground, as it would μ.
"""

from dataclasses import replace

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.lens_selection import (
    ENOUGH_IMAGES,
    free_parameters,
    has_plausible_center,
    leaves_noise,
)


def with_third_coefficient(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """A problem and its fit, with ν free where μ and the centre are, and the errors are noise."""
    adjusted, observations, finer = fit.adjusted, problem.observations, free_parameters("division3")
    if problem.count < ENOUGH_IMAGES or (fit.free_lens != free_parameters("division2")).any():
        return problem, fit
    if not leaves_noise(adjusted, observations):
        return problem, fit
    wider = problem.extend(fit, finer)
    if not has_plausible_center(wider.adjusted, observations):
        return problem, fit
    return replace(problem, free_lens=finer), wider
