"""The least free model that the data allow.

Every model is judged by a robust likelihood of its errors, with the scatter that the freest model leaves, and pays
for each of its parameters (Schwarz's criterion). Two things keep that honest on real pictures: errors of neighbours
agree, so that there are fewer independent observations than correspondences; and no lens or plane is exact to better
than about a tenth of a pixel, which therefore counts as noise.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rdstitch.registration.bundle_adjustment import WIDTH_PER_SIGMA
from rdstitch.registration.consistency import misfitting_links
from rdstitch.registration.models import LOG_HEIGHT
from rdstitch.registration.normal_equations import whitened_errors
from rdstitch.registration.problem import Fit, Problem
from rdstitch.registration.relief import coherence

_EXACTNESS = 0.1
"""px: how exactly a lens and a plane can be described at all."""


@dataclass(frozen=True)
class Choice:
    """The model chosen.

    Attributes
    ----------
    fit : Fit
    reason : str
    overdispersion : float
        Of the freest model's errors, see :class:`rdstitch.registration.relief.Coherence`.
    """

    fit: Fit
    reason: str
    overdispersion: float


def choose_model(problem: Problem, fits: Sequence[Fit]) -> Choice:
    """The best of the models, given from the least to the most free."""
    freest = fits[-1].adjusted
    observations = problem.observations
    errors = whitened_errors(observations, freest.homographies, freest.parameters.lens)
    inliers = freest.squared <= (WIDTH_PER_SIGMA * freest.sigma) ** 2
    overdispersion = coherence(observations, errors, inliers).overdispersion
    right = ~misfitting_links(freest.squared, observations)[observations.link]
    noise = math.hypot(freest.sigma, _EXACTNESS)
    effective = 2.0 * float((right & inliers).sum()) / overdispersion
    costs = []
    for fit in fits:
        ratio = np.minimum(fit.adjusted.squared[right], 1e12) / noise**2
        width = WIDTH_PER_SIGMA**2
        misfit = float((width * np.log1p(ratio / width)).sum()) / overdispersion
        costs.append(misfit + _parameters(problem, fit) * math.log(max(effective, 2.0)))
    best = int(np.argmin(costs))
    return Choice(fits[best], _reason(fits, best), overdispersion)


def _parameters(problem: Problem, fit: Fit) -> int:
    """Free parameters of a fit."""
    poses = problem.count * fit.model.pose_size - int(fit.model.gauge.sum())
    return poses + len(fit.model.shared_names) + int(problem.free_lens.sum())


def _reason(fits: Sequence[Fit], best: int) -> str:
    """Why the model was taken, one sentence."""
    name, own = fits[best].model.name, fits[best].adjusted.sigma
    what = {
        "rigid": "height and tilt stay the same",
        "similarity": f"the tilt stays the same, heights differ by {_height_spread(fits[best]):.0%}",
        "tilting": f"heights differ by {_height_spread(fits[best]):.0%}, "
        f"tilts by {math.degrees(fits[best].tilt_spread):.1f} degrees",
        "homography": "no planar motion of one camera describes the pictures",
    }[name]
    if len(fits) == 1:
        return f"{name}: as asked for; it leaves an error of {own:.2f} px"
    less = "; ".join(f"{fit.model.name} {fit.adjusted.sigma:.2f} px" for fit in fits[:best])
    more = "; ".join(f"{fit.model.name} {fit.adjusted.sigma:.2f} px" for fit in fits[best + 1 :])
    return (
        f"{name}: {what}; it leaves an error of {own:.2f} px"
        + (f", less free models more ({less})" if less else "")
        + (f", more freedom gains too little ({more})" if more else "")
    )


def _height_spread(fit: Fit) -> float:
    """Relative standard deviation of the heights; 0 for the general model."""
    poses = fit.adjusted.parameters.poses
    return float(np.std(poses[:, LOG_HEIGHT])) if fit.model.shared_names else 0.0
