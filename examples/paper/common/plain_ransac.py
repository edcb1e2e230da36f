"""Plain RANSAC, the same for every solver: no local optimisation, which would hide what the solvers differ in."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from examples.paper.common.contenders import HOMLIB, homlib_solver
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.minimal import MinimalSolver, Solve, minimal_solvers
from rdstitch.robust.pair_models import HomographyPairModel
from rdstitch.robust.priors import focal_prior
from rdstitch.robust.sampling import Sampler
from rdstitch.robust.scoring import plausible, transfer_errors2
from rdstitch.solvers import Solutions

THRESHOLD = 3.0
"""Largest transfer error of an inlier, px."""

_SOLUTIONS_AT_ONCE = 100


def all_solvers(camera: Camera, tilt: tuple[float, float]) -> list[MinimalSolver]:
    """All minimal solvers, ours and, where it is installed, homlib's, in the half-diagonal frame.

    ``camera``: with a focal length. ``tilt``: (ψ, θ), radians, for the solvers that are told it.
    """
    assert camera.focal is not None
    focal = camera.focal / camera.scale
    given = partial(minimal_solvers, focal, focal_prior(math.log(focal), 0.01, "option"))
    told, untold, flat = given(True, None), given(False, None), given(True, 0.0)
    told = tuple(replace(solver, solve=_with_tilt(solver, tilt)) for solver in told)
    names = {
        "2 points, tilt given": (told, "two_point"),
        "3 points, tilt given, height free": (told, "three_point_similarity"),
        "3 points": (untold, "three_point"),
        "4 points": (untold, "four_point"),
        "5 points": (untold, "five_point"),
        "4 points, no distortion (DLT)": (flat, "four_point_dlt"),
    }
    found = [replace(next(s for s in group if s.name == key), name=name) for name, (group, key) in names.items()]
    for name, function, arguments in HOMLIB:
        solve = homlib_solver(function, *arguments)
        if solve is not None:
            found.append(MinimalSolver(name, 5, _without_tilt(solve), HomographyPairModel()))
    return found


def _without_tilt(solve: Callable[[FloatArray, FloatArray], Solutions]) -> Solve:
    """A solver that takes no tilts, as one that is given none."""

    def solve_without(x1: FloatArray, x2: FloatArray, tilts: FloatArray | None = None) -> Solutions:
        return solve(x1, x2)

    return solve_without


def _with_tilt(solver: MinimalSolver, tilt: tuple[float, float]) -> Solve:
    """What a solver finds where both images of every sample have one known tilt."""

    def solve(x1: FloatArray, x2: FloatArray, tilts: FloatArray | None = None) -> Solutions:
        return solver.solve(x1, x2, np.broadcast_to(tilt, (len(x1), 2, 2)))

    return solve


def draw_samples(solver: MinimalSolver, data: Measurements, count: int, seed: int) -> tuple[Solutions, FloatArray]:
    """Solutions (M) of ``count`` uniform samples, and how many matches agree with each (M,)."""
    start, ordered = np.zeros(1, dtype=np.intp), np.zeros(1, dtype=np.bool_)
    picks = Sampler(solver.sample_size, 1, [seed]).draw(start, count, data.count, ordered)[0]
    found = solver.solve(data.x1[0].T[picks], data.x2[0].T[picks], None)
    return found, _inliers(found, data)


def best_of(solver: MinimalSolver, data: Measurements, count: int, seed: int) -> tuple[FloatArray, float] | None:
    """Homography (3, 3) and λ of the solution that most matches agree with; None where no sample has one."""
    found, inliers = draw_samples(solver, data, count, seed)
    if not len(found) or inliers.max() == 0.0:
        return None
    best = int(np.argmax(inliers))
    return found.homography[best], float(found.distortion[best])


def _inliers(found: Solutions, data: Measurements) -> FloatArray:
    """Number of matches within the threshold, of each solution (M,)."""
    result = np.zeros(len(found))
    possible = np.flatnonzero(plausible(found, corner_radius=1.0))
    for part in np.array_split(possible, max(1, len(possible) // _SOLUTIONS_AT_ONCE)):
        pair = np.zeros(len(part), dtype=np.intp)
        errors2 = transfer_errors2(found.homography[part], found.distortion[part], pair, data)
        result[part] = ((errors2 < THRESHOLD**2) & data.present).sum(axis=1)
    return result
