"""Did the camera turn on the spot, or move over a plane? The least free model that the data allow.

A turn has three parameters a picture, as few as a rigid motion over a plane, and needs no plane. Where it explains the
pictures, models over a plane do so too, with more parameters: a camera that stays where it is sees the same of a plane
as of anything else. So the turn is taken where it fits, and a plane where there is translation.
"""

import math
from collections.abc import Sequence

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.lens_selection import has_plausible_center
from rdstitch.alignment.model_selection import ModelChoice, choose_model, fit_cost, noise_of_links, price
from rdstitch.alignment.motion_models import RIGID, SIMILARITY, TILTING
from rdstitch.alignment.noise_model import EXACTNESS, NoiseModel
from rdstitch.alignment.rotation_model import ROTATION
from rdstitch.arrays import BoolArray

_FAR, _AS_GOOD = math.radians(45.0), 1.2
"""Angle between optical axes, and errors in units of those of pairs on their own, from and up to which a plane is not
tried: of a plane, a camera that turns as far sees the horizon."""

_PARALLAX = 0.0015
"""Of a picture's diagonal: errors up to which a camera that turned far, held by hand, still counts as having turned on
the spot. More freedom would explain them, and stretch the pictures over a plane that is not there. A centre that moves
by 8 % of the scene's distance leaves 0.0012; over a plane, a turn as far leaves 0.003 to 0.007."""

_STEADY = math.radians(6.0)
"""Spread of the tilts of a camera over a plane, up to which it did not turn as far instead: tilts that stand for such a
turn spread over 11 degrees and more, those of a drone over 1 to 3."""

_POSSIBLE = 4.0
"""Times the noise that pairs may be off from a turn on the spot for it to be tried on all of them."""


def choose_motion(problem: Problem, names: Sequence[str], lenses: Sequence[BoolArray] = ()) -> ModelChoice:
    """The turn on the spot, or the best of the models over a plane; see :func:`choose_model`.

    Where no model over a plane could explain the pictures better than a turn does, none is tried.
    """
    planar = [name for name in names if name != ROTATION.name]
    if len(planar) == len(names):
        return choose_model(problem, names, lenses)
    bound, least = noise_of_links(problem)
    trial = problem.trial(ROTATION)
    parallax = _PARALLAX * 2.0 * float(np.median(problem.observations.scale2))
    possible = trial.sigma <= _POSSIBLE * bound.noise
    if planar and not possible and trial.sigma > parallax:
        return choose_model(problem, planar, lenses)
    turned = problem.fit(ROTATION, shared=trial.parameters.shared)
    if not planar:
        reason = f"as requested; it leaves an error of {turned.adjusted.sigma:.2f} pixels"
        return _choice(problem, bound, turned, lenses, reason)
    explained = (
        "the camera turned on the spot, so that the pictures say nothing of the scene's shape (a plane seen from one "
        f"place would look the same); it leaves an error of {turned.adjusted.sigma:.2f} pixels"
    )
    sigma = math.hypot(turned.adjusted.sigma, EXACTNESS)
    as_good = sigma < _AS_GOOD * bound.noise
    if _turns_far(turned) and (as_good or (sigma < parallax and not _is_over_plane(problem, bound))):
        return _choice(problem, bound, turned, lenses, explained)
    if not possible:
        return choose_model(problem, planar, lenses)
    if fit_cost(bound, problem, turned) <= least + price(bound, problem, RIGID, problem.free_lens):
        return _choice(problem, bound, turned, lenses, f"{explained}, and nothing is left for more freedom to gain")
    over_plane = choose_model(problem, planar, lenses)
    if fit_cost(bound, problem, over_plane.fit) < fit_cost(bound, problem, turned):
        return over_plane
    other = over_plane.fit
    gains = f"{explained}, more freedom gains too little ({other.model.name} {other.adjusted.sigma:.2f} pixels)"
    return _choice(problem, bound, turned, lenses, gains)


def _is_over_plane(problem: Problem, noise: NoiseModel) -> bool:
    """Whether a camera that hardly tilts over a plane explains the pictures as well as pairs on their own do.

    A row of pictures over a plane can be bent into a turn with an odd lens; parallax does not make a plane of a turn.
    """
    fits: list[Fit] = []
    for model in (RIGID, SIMILARITY, TILTING):
        fits.append(problem.fit(model, fits[-1:]))
        if math.hypot(fits[-1].adjusted.sigma, EXACTNESS) < _AS_GOOD * noise.noise:
            return fits[-1].tilt_spread < _STEADY
    return False


def _turns_far(turned: Fit) -> bool:
    """Whether the optical axes differ by more than those of a camera over a plane can."""
    axes = turned.adjusted.parameters.poses.reshape(-1, 3, 3)[:, 2]
    return float((axes @ axes.T).min()) < math.cos(_FAR)


def _choice(problem: Problem, noise: NoiseModel, turned: Fit, lenses: Sequence[BoolArray], reason: str) -> ModelChoice:
    """The turn, with more of the lens free where that pays."""
    for lens in lenses:
        wider = problem.extend(turned, lens | turned.free_lens)
        plausible = has_plausible_center(wider.adjusted, problem.observations)
        if plausible and fit_cost(noise, problem, wider) < fit_cost(noise, problem, turned):
            turned = wider
    return ModelChoice(turned, f"{ROTATION.name}: {reason}", noise.overdispersion)
