"""GPS positions as a weak prior: what bends a long chain of pictures hardly changes how well neighbours fit.

The plane is a view from above, so that a similarity takes metres east and south to where the adjustment has put the
cameras. It is fitted robustly, the cameras are drawn towards it, and so in turn. Where the pictures disagree, with
larger errors or with cameras that stay away, the positions do not count.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.motion_models import PlanarModel, X, Y
from rdstitch.alignment.noise_model import EXACTNESS
from rdstitch.arrays import FloatArray

POSITION_STD = 3.0
"""Metres: of one coordinate of a position by a receiver without corrections, within one flight."""

_MIN_POSITIONS, _MIN_SPREAD = 4, 5.0
"""Positions, and standard deviations that they must be spread over, to say anything of the shape."""

_ROUNDS, _SETTLED = 6, 0.1
"""Of fitting the similarity and adjusting again; standard deviations by which positions still move at the end."""

_OUTLYING = 3.0
"""Standard deviations from which on a position counts little."""

_MAX_GROWTH = 1.1
"""Times by which the errors of the pictures may grow."""


def hold_positions(problem: Problem, fit: Fit) -> tuple[Problem, Fit, str]:
    """Adjust again with the positions as priors.

    Parameters
    ----------
    problem : Problem
    fit : Fit
        Of the problem, without them.

    Returns
    -------
    Problem, Fit
        Those given where there are too few positions, or where the pictures disagree with them.
    str
        Why they do not count; empty where they do, or where there are too few.
    """
    positions = problem.camera_priors.positions
    metres = positions @ np.array([1.0, -1.0j])
    known = np.isfinite(metres)
    if not isinstance(fit.model, PlanarModel) or known.sum() < _MIN_POSITIONS or _spread(metres[known]) < _MIN_SPREAD:
        return problem, fit, ""
    held, found = problem, fit
    for _ in range(_ROUNDS):
        here = _places(found)
        there, precision = _prior(metres, here, known)
        priors = replace(problem.camera_priors, places=there, places_precision=precision)
        held = replace(problem, camera_priors=priors)
        found = held.refine(fit.model, found.adjusted.parameters, fit.tilt_spread or None)
        if np.abs(_places(found) - here).max() ** 2 * precision.max() < _SETTLED**2:
            break
    there, precision = _prior(metres, _places(found), known)
    off = np.abs(_places(found) - there @ np.array([1.0, 1.0j]))[known] * math.sqrt(precision.max())
    growth = math.hypot(found.adjusted.sigma, EXACTNESS) / math.hypot(fit.adjusted.sigma, EXACTNESS)
    if growth <= _MAX_GROWTH and np.median(off) <= _OUTLYING:
        return held, found, ""
    return (
        problem,
        fit,
        (
            f"the GPS positions disagree with the pictures, by {POSITION_STD * np.median(off):.0f} m in the median: "
            "they were not used"
        ),
    )


def _spread(metres: NDArray[np.complex128]) -> float:
    """Of positions, standard deviations."""
    return float(np.std(metres)) / POSITION_STD


def _places(fit: Fit) -> NDArray[np.complex128]:
    """Where the cameras are above the plane (N,), in units of the poses."""
    places: NDArray[np.complex128] = fit.adjusted.parameters.poses[:, [X, Y]] @ np.array([1.0, 1.0j])
    return places


def _prior(
    metres: NDArray[np.complex128], here: NDArray[np.complex128], known: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Where the positions say that the cameras are (N, 2), and how surely, as inverse variances (N,)."""
    weight, scale, origin, away = known.astype(np.float64), 0.0j, 0.0j, np.zeros(len(metres))
    filled = np.where(known, metres, 0.0)
    for _ in range(10):
        a, b = (np.average(points, weights=weight) for points in (filled, here))
        power = float(np.vdot(filled - a, weight * (filled - a)).real)
        scale = complex(np.vdot(filled - a, weight * (here - b))) / max(power, 1e-300)
        origin = complex(b - scale * a)
        away = np.abs(here - scale * filled - origin) / max(abs(scale), 1e-300)
        width = _OUTLYING * max(POSITION_STD, float(np.median(away[known])))
        weight = known / (1.0 + (away / width) ** 2) ** 2
    there = np.where(known, scale * filled + origin, 0.0)
    precision = weight / max(abs(scale) * POSITION_STD, 1e-12) ** 2
    return np.stack([there.real, there.imag], axis=1), precision
