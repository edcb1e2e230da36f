"""The least free model that the data allow; one camera, unless the pictures cannot come from one.

Models of one camera are judged by a robust likelihood of their errors, with the scatter that the freest of them
leaves, and pay for each parameter (Schwarz's criterion); see :mod:`rdstitch.alignment.noise_model`.

One free homography a picture is a model of another kind: it fits relief better than any camera does, and its chains
drift projectively. It is taken only for what one camera cannot explain, a zoom, a moving principal point or pictures of
pictures, where it leaves much smaller errors, and noise alone: where neighbours agree in those, too, the ground is
rough, and long slopes look like homographies of their own. Over strips of rendered relief the factor is up to 2.2
(``python -m tests.benchmarks.relief``), over trees and a river 1.2 to 1.3.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.lens_selection import shows_center
from rdstitch.alignment.link_equations import squared_lengths, whitened_errors
from rdstitch.alignment.motion_models import (
    HOMOGRAPHY,
    LOG_HEIGHT,
    PLANAR_MODELS,
    POSE,
    PSI,
    THETA,
    MotionModel,
    PlanarModel,
)
from rdstitch.alignment.noise_model import EXACTNESS, NoiseModel
from rdstitch.alignment.planarity import LARGE_RELIEF
from rdstitch.arrays import BoolArray

NOT_ONE_CAMERA = "the pictures do not come from one camera with one focal length"
"""Why free homographies were taken."""

_MIN_RATIO = 1.5
"""Times by which the errors of one camera must exceed those of free homographies."""

_MIN_RATIO_OVER_RELIEF = 3.0
"""The same where neighbours agree in the errors of free homographies, too."""

_FOCAL_LIMITS = 0.2, 50.0
"""Half diagonals: focal lengths that a model may ask for; the widest fisheyes have 0.3."""

_TYPICAL_TILT_SPREAD = math.radians(3.0)
"""Spread of tilts from which on a wider one costs: Occam's factor of the hierarchical prior on the tilts."""


@dataclass(frozen=True)
class ModelChoice:
    """The model chosen.

    Attributes
    ----------
    fit : Fit
    reason : str
    overdispersion : float
        Of the freest model's errors, see :class:`rdstitch.alignment.planarity.Coherence`.
    over_relief : bool
        Whether it was chosen with heights of the ground that account for errors along the parallax.
    """

    fit: Fit
    reason: str
    overdispersion: float
    over_relief: bool = False


def choose_model(problem: Problem, names: Sequence[str], lenses: Sequence[BoolArray] = ()) -> ModelChoice:
    """Adjust models from the least to the most free, and take the best.

    The best two and the least free one are then tried with more of the lens free: an off-centre lens acts like less
    regular motion.

    A homography for every link on its own leaves errors that no model of the family can undercut. Once freer models
    could not pay for their freedom even with those, they are not tried.
    """
    bound, least = noise_of_links(problem)
    if problem.count == 2 and len(names) > 1:  # with two pictures, one camera in any pose is a homography
        names = [name for name in names if name != POSE.name]
    fits: list[Fit] = []
    for name in names:
        model = PLANAR_MODELS[name]
        cost = min((fit_cost(bound, problem, fit) for fit in fits), default=math.inf)
        if cost <= least + price(bound, problem, model, problem.free_lens) or _cannot_gain(bound, problem, fits, model):
            break
        fits.append(problem.fit(model, fits[-1:]))
    cameras = [fit for fit in fits if fit.model is not HOMOGRAPHY]
    noise = bound if len(fits) < len(names) else _noise_of_fit(problem, fits[-1])
    costs = np.array([fit_cost(noise, problem, fit) if has_plausible_focal(fit) else math.inf for fit in fits])
    for lens in lenses:
        # The least free one besides: an off-centre lens may have ruled it out.
        for index in sorted({0, *np.argsort(costs, kind="stable")[:2].tolist()}):
            wider = problem.extend(fits[index], lens | fits[index].free_lens)
            cost = fit_cost(noise, problem, wider)
            plausible = has_plausible_focal(wider) and shows_center(wider.adjusted, problem.observations)
            if cost < costs[index] and plausible:
                fits[index], costs[index] = wider, cost
    best = int(np.argmin(costs[: max(len(cameras), 1)]))
    if cameras and len(fits) > len(cameras) and _beyond_one_camera(problem, fits[best], fits[-1]):
        best = len(fits) - 1
    return ModelChoice(fits[best], _reason(fits, best, list(names)), noise.overdispersion)


def least_costly(problem: Problem, fits: Sequence[Fit]) -> ModelChoice:
    """The best of some models of one camera, which were adjusted to the problem, from the least to the most free."""
    noise = _noise_of_fit(problem, fits[-1])
    costs = [fit_cost(noise, problem, fit) if has_plausible_focal(fit) else math.inf for fit in fits]
    best = int(np.argmin(costs))
    reason = _reason(fits, best, [fit.model.name for fit in fits])
    return ModelChoice(fits[best], reason, noise.overdispersion)


def evidence_against(problem: Problem, free: Fit, fit: Fit) -> float:
    """By how much the cost of the freer of two fits exceeds that of the other."""
    noise = _noise_of_fit(problem, free)
    return fit_cost(noise, problem, free) - fit_cost(noise, problem, fit)


def has_plausible_focal(fit: Fit) -> bool:
    """Whether a lens can have the focal length of a fit: over relief, small tilts may ask for any."""
    if not fit.model.shared_names:
        return True
    focal = math.exp(float(fit.model.physical_parameters(fit.adjusted.parameters.shared)[0][-1]))
    return _FOCAL_LIMITS[0] < focal < _FOCAL_LIMITS[1]


def _cannot_gain(bound: NoiseModel, problem: Problem, fits: Sequence[Fit], model: MotionModel) -> bool:
    """Whether free homographies could not leave errors so much smaller that they would be taken."""
    if model is not HOMOGRAPHY or not fits or problem.count == 2:
        return False
    least = min(math.hypot(fit.adjusted.sigma, EXACTNESS) for fit in fits)
    return least < _MIN_RATIO * bound.noise


def _beyond_one_camera(problem: Problem, camera: Fit, free: Fit) -> bool:
    """Whether free homographies explain the pictures so much better that they cannot come from one camera.

    The variance of the errors is unknown, and only as many of them are independent as those of the camera show:
    ``n log σ² + k log n`` decides (Schwarz's criterion). Two pictures need no more than one homography.
    """
    rough = _noise_of_fit(problem, free).common > LARGE_RELIEF
    least = _MIN_RATIO_OVER_RELIEF if rough else _MIN_RATIO
    noise = _noise_of_fit(problem, camera)
    variance = [fit.adjusted.sigma**2 + EXACTNESS**2 for fit in (camera, free)]
    count = [parameter_count(problem, fit.model, fit.free_lens) for fit in (camera, free)]
    gain = noise.effective * math.log(variance[0] / variance[1])
    earned = gain > (count[1] - count[0]) * noise.price
    return earned and (count[1] <= count[0] or variance[0] > least**2 * variance[1])


def parameter_count(problem: Problem, model: MotionModel, free_lens: BoolArray) -> int:
    """Number of free parameters; in the pose model the shared tilt is only the mean of those of the pictures."""
    poses = problem.count * model.pose_size - int(model.gauge.sum())
    return poses + len(model.shared_names) + int(free_lens.sum()) - (2 if model is POSE else 0)


def price(noise: NoiseModel, problem: Problem, model: MotionModel, free_lens: BoolArray) -> float:
    """What the parameters of a model cost."""
    return parameter_count(problem, model, free_lens) * noise.price


def fit_cost(noise: NoiseModel, problem: Problem, fit: Fit) -> float:
    """Misfit and price of a fit, and what its camera is off from what is known of it.

    Tilts that might be anything cost more than those that hardly differ.
    """
    wide = 0.0
    if fit.tilt_spread > 0.0:
        wide = 4.0 * problem.count * math.log(max(fit.tilt_spread / _TYPICAL_TILT_SPREAD, 1.0))
    misfit = float(noise.misfit(fit.adjusted.squared).sum())
    priors = problem.adjuster_of(fit).camera_prior_cost(fit.adjusted.parameters)
    return misfit + price(noise, problem, fit.model, fit.free_lens) + wide + priors


def noise_of_links(problem: Problem) -> tuple[NoiseModel, float]:
    """The noise that every link on its own leaves, and the misfit, which no model of the family can undercut."""
    errors = whitened_errors(problem.observations, problem.homographies, problem.lens)
    noise = NoiseModel.of_independent_links(problem.observations, errors)
    return noise, float(noise.misfit(squared_lengths(errors)).sum())


def _noise_of_fit(problem: Problem, fit: Fit) -> NoiseModel:
    """The noise that a model leaves."""
    adjusted = fit.adjusted
    errors = whitened_errors(problem.observations, adjusted.homographies, adjusted.parameters.lens)
    return NoiseModel.of_errors(problem.observations, errors)


def _reason(fits: Sequence[Fit], best: int, names: Sequence[str]) -> str:
    """Why the model was taken, one sentence."""
    name, own = fits[best].model.name, fits[best].adjusted.sigma
    what = {
        "rigid": "height and tilt stay the same",
        "similarity": f"the tilt stays the same, heights differ by {_height_spread(fits[best]):.0%}",
        "tilting": f"heights differ by {_height_spread(fits[best]):.0%}, "
        f"tilts by {math.degrees(fits[best].tilt_spread):.1f} degrees",
        "pose": f"one camera in any pose, tilted by up to {_largest_tilt(fits[best]):.0f} degrees",
        "homography": NOT_ONE_CAMERA
        if len(fits) > 1 and fits[best].adjusted.parameters.poses.shape[0] > 2
        else "two pictures need no more",
    }[name]
    if len(names) == 1:
        return f"{name}: as requested; it leaves an error of {own:.2f} pixels"
    less = ", ".join(f"{fit.model.name} {fit.adjusted.sigma:.2f} pixels" for fit in fits[:best])
    more = ", ".join(f"{fit.model.name} {fit.adjusted.sigma:.2f} pixels" for fit in fits[best + 1 :])
    return (
        f"{name}: {what}; it leaves an error of {own:.2f} pixels"
        + (f", less free models more ({less})" if less else "")
        + (f", more freedom gains too little ({more})" if more else "")
        + (", and free homographies could gain too little" if len(fits) < len(names) else "")
    )


def _largest_tilt(fit: Fit) -> float:
    """Largest angle between the optical axis and the normal of the plane, degrees; 0 for the general model."""
    if not isinstance(fit.model, PlanarModel):
        return 0.0
    tilts = fit.model.metric_poses(fit.adjusted.parameters.poses, fit.adjusted.parameters.shared)[:, [PSI, THETA]]
    return math.degrees(float(np.arccos(np.cos(tilts).prod(axis=1)).max()))


def _height_spread(fit: Fit) -> float:
    """Relative standard deviation of the heights; 0 for the general model."""
    poses = fit.adjusted.parameters.poses
    return float(np.std(poses[:, LOG_HEIGHT])) if fit.model.shared_names else 0.0
