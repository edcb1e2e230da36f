"""How far λ can be off by what was not estimated: other parameters of the lens, an odd focal length, another motion."""

import math
from dataclasses import replace

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.motion_models import HOMOGRAPHY, PlanarModel
from rdstitch.alignment.sandwich import sandwich_covariance
from rdstitch.alignment.select import Posterior
from rdstitch.alignment.shape_test import UNLIKELY_FOCAL, beside_usual_focal
from rdstitch.arrays import FloatArray


def considered_covariance(problem: Problem, fit: Fit, *, rough: bool) -> FloatArray:
    """Covariance (5, 5) of all parameters of a lens, also of those that were not freed: consider parameters (Schmidt
    1966).

    That a lens of fewer parameters explains the images does not make it the lens. What they leave open of the others,
    within what lenses usually have, moves λ where these images show nothing. So does a focal length that next to no
    lens has: something else bends the images, and λ may be what goes with the usual one. Where the ground is
    ``rough`` that is known, and in the covariance.
    """
    free_every = replace(problem, free_lens=np.ones_like(problem.free_lens))
    count = len(problem.free_lens)
    adjuster = free_every.adjuster_of(fit)
    covariance: FloatArray = sandwich_covariance(adjuster, fit.adjusted)[-count:, -count:]
    beside = beside_usual_focal(problem, fit)
    if not rough and abs(beside) > UNLIKELY_FOCAL * problem.camera_priors.log_focal_std:
        together = adjuster.covariance(fit.adjusted)
        focal = len(fit.model.shared_names) - 1
        moved = together[-count:, focal] * (beside / together[focal, focal])
        covariance = covariance + np.outer(moved, moved)
    if problem.count == 2 and isinstance(fit.model, PlanarModel):
        covariance = _with_free_motion(problem, fit, covariance, rough=rough)
    return covariance


def _with_free_motion(problem: Problem, fit: Fit, covariance: FloatArray, *, rough: bool) -> FloatArray:
    """The covariance (5, 5) over two models: the one taken, and a homography (Buckland, Burnham and Augustin 1997).

    Of two images nothing but their errors says whether they were tilted alike, and over rough ground they say little.
    Each model counts as much as Schwarz's criterion makes it likely.
    """
    free = problem.fit(HOMOGRAPHY)
    posterior = Posterior(problem)
    against = float(np.clip((posterior.of(free).score - posterior.of(fit).score) / 2.0, -50.0, 50.0))
    share = 1.0 / (1.0 + math.exp(against))
    off = free.adjusted.parameters.lens - fit.adjusted.parameters.lens
    other = considered_covariance(problem, free, rough=rough) + np.outer(off, off)
    mixed: FloatArray = (1.0 - share) * covariance + share * other
    return mixed
