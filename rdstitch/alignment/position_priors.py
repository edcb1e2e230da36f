"""GPS positions as a weak prior: what bends a long chain of images hardly changes how well neighbours fit.

The plane is a view from above, so that a similarity takes metres east and south to where the adjustment has put the
cameras. It is fitted robustly, the cameras are drawn towards it, and so in turn. Where the images disagree, with
larger errors or with cameras that stay away, the positions do not count.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.motion_models import PlanarModel, X, Y
from rdstitch.arrays import FloatArray
from rdstitch.robust.posterior import EXACTNESS
from rdstitch.robust.similarity_fit import OUTLYING, fit_similarity

POSITION_STD = 3.0
"""Metres: of one coordinate of a position by a receiver without corrections, within one flight."""

_MIN_POSITIONS, _MIN_SPREAD = 4, 5.0
"""Positions, and standard deviations that they must be spread over, to say anything of the shape."""

_ROUNDS, _SETTLED = 6, 0.1
"""Of fitting the similarity and adjusting again; standard deviations by which positions still move at the end."""

_MAX_GROWTH = 1.1
"""Times by which the errors of the images may grow."""


def hold_positions(problem: Problem, fit: Fit) -> tuple[Problem, Fit, str]:
    """Adjust again with the positions as priors.

    What was given comes back where there are too few of them, or, with the reason, where the images disagree with them.
    """
    metres = problem.camera_priors.positions @ np.array([1.0, -1.0j])
    known = np.isfinite(metres)
    if not isinstance(fit.model, PlanarModel) or known.sum() < _MIN_POSITIONS or _spread(metres[known]) < _MIN_SPREAD:
        return problem, fit, ""
    held, refined = problem, fit
    for _ in range(_ROUNDS):
        here = _places(refined)
        target, precision = _prior(metres, here, known)
        priors = replace(problem.camera_priors, places=target, places_precision=precision)
        held = replace(problem, camera_priors=priors)
        refined = held.refine(fit.model, refined.adjusted.parameters, fit.tilt_spread or None)
        if np.abs(_places(refined) - here).max() ** 2 * precision.max() < _SETTLED**2:
            break
    target, precision = _prior(metres, _places(refined), known)
    off = np.abs(_places(refined) - target @ np.array([1.0, 1.0j]))[known] * math.sqrt(precision.max())
    growth = math.hypot(refined.adjusted.sigma, EXACTNESS) / math.hypot(fit.adjusted.sigma, EXACTNESS)
    if growth <= _MAX_GROWTH and np.median(off) <= OUTLYING:
        return held, refined, ""
    why = (
        f"half of them are {POSITION_STD * np.median(off):.0f} m or more from where the images were taken"
        if np.median(off) > OUTLYING
        else f"with them the errors of the matches grow by {growth - 1.0:.0%}"
    )
    return problem, fit, f"the GPS positions contradict the images ({why}) and were not used for the alignment"


def _spread(metres: NDArray[np.complex128]) -> float:
    """Of positions, standard deviations, whatever a few of them are."""
    middle = complex(np.median(metres.real), np.median(metres.imag))
    return float(np.median(np.abs(metres - middle))) / POSITION_STD


def _places(fit: Fit) -> NDArray[np.complex128]:
    """Where the cameras are above the plane (N,), in units of the poses."""
    places: NDArray[np.complex128] = fit.adjusted.parameters.poses[:, [X, Y]] @ np.array([1.0, 1.0j])
    return places


def _prior(
    metres: NDArray[np.complex128], here: NDArray[np.complex128], known: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Where the positions say that the cameras are (N, 2), and how surely, as inverse variances (N,)."""
    fit = fit_similarity(here[known], metres[known], POSITION_STD)
    scale = fit.scale or 1e-300
    target, precision = np.zeros((len(metres), 2)), np.zeros(len(metres))
    target[known] = ((metres[known] - fit.origin) / scale).view(np.float64).reshape(-1, 2)
    precision[known] = fit.weights * (abs(scale) / POSITION_STD) ** 2
    return target, precision
