"""Fig. 7: inliers against RANSAC iterations, averaged over many runs, for every solver.

Plain RANSAC, the same for all: draw a sample, solve it, count the matches that agree with the best of its solutions,
keep the best so far. No local optimisation, which would hide the differences.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from examples.paper.contenders import HOMLIB
from examples.paper.matched import MatchedPair, match_files, match_rendered, rendered_pair
from examples.paper.peers import absent, homlib_solver
from examples.paper.plots import curves
from examples.paper.report import Report, Table
from examples.paper.settings import Effort, Settings
from rdstitch.camera import Camera, FloatArray
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.minimal import MinimalSolver, minimal_solvers
from rdstitch.robust.pair_models import HomographyModel
from rdstitch.robust.sampling import Sampler
from rdstitch.robust.scoring import plausible, transfer_errors2
from rdstitch.solvers import Solutions

ITERATIONS = (1, 2, 5, 10, 20, 50, 100, 200)
"""At which the inliers are reported."""

_THRESHOLD = 3.0  # px
_RATIO = 0.95  # of the matches: loose, so that there is something to do
_RENDERED_TILT = (0.05, -0.04)
_SAMPLES_AT_ONCE = 1000


@dataclass(frozen=True)
class _Curve:
    """Mean share of inliers (iterations,) of one solver."""

    solver: str
    share: FloatArray


def run(settings: Settings) -> Report:
    """Mean number of inliers of the best model after so many iterations."""
    runs = settings.count(5, 60, 500)
    pairs = _pairs(settings)
    curves_of = {pair.name: _curves(pair, runs) for pair in pairs}
    tables = tuple(_table(pair, curves_of[pair.name], runs) for pair in pairs)

    def draw(figure: Any) -> None:
        for axes, pair in zip(np.atleast_1d(figure.subplots(1, len(pairs))), pairs, strict=True):
            series = {curve.solver: curve.share.tolist() for curve in curves_of[pair.name]}
            steps = np.arange(1, ITERATIONS[-1] + 1)
            curves(axes, steps, series, "iterations", "share of inliers")
            axes.set_title(pair.name, fontsize=8)

    notes = absent("homlib")
    if not settings.real_sequence("garfield_red"):
        notes += ("the real pictures garfield_red are not here and were left out",)
    return Report(tables, draw, notes=notes)


def _pairs(settings: Settings) -> list[MatchedPair]:
    """A rendered pair of planar motion, and a real one of a drone."""
    size = (320, 240) if settings.effort is Effort.TINY else (640, 480)
    lens = Camera(size, -0.3, focal=0.8 * size[0], focal_source="option")
    sequence = rendered_pair(lens, seed=7, tilt=_RENDERED_TILT)
    rendered = match_rendered(sequence, "rendered pair, planar motion", ratio=_RATIO)
    real = match_files(settings.real_sequence("garfield_red")[:2], ratio=_RATIO)
    return [rendered, *(replace(pair, name="garfield_red, first pair") for pair in real)]


def _curves(pair: MatchedPair, runs: int) -> list[_Curve]:
    data = Measurements.from_pixels(pair.points1, pair.points2, pair.camera, pair.camera, None)
    return [
        _Curve(solver.name, _mean_share(solver, data, runs, seed))
        for seed, solver in enumerate(_solvers(pair.camera, pair.tilt))
    ]


def _solvers(camera: Camera, tilt: tuple[float, float]) -> list[MinimalSolver]:
    """All minimal solvers, in the half-diagonal frame."""
    assert camera.focal is not None
    given = partial(minimal_solvers, camera.focal / camera.half_diagonal, 0.01)
    told, untold, flat = given((tilt, tilt), None), given(None, None), given((tilt, tilt), 0.0)
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
            found.append(MinimalSolver(name, 5, solve, HomographyModel()))
    return found


def _mean_share(solver: MinimalSolver, data: Measurements, runs: int, seed: int) -> FloatArray:
    """Mean over the runs of the share of inliers of the best model so far, shape (iterations,)."""
    length = ITERATIONS[-1]
    counts = np.zeros(runs * length)
    sampler = Sampler(len(data), solver.sample_size, None, 1, [seed])
    for start in range(0, len(counts), _SAMPLES_AT_ONCE):
        part = slice(start, min(start + _SAMPLES_AT_ONCE, len(counts)))
        picks = sampler.draw(part.stop - part.start)
        found = solver.solve(data.x1[picks], data.x2[picks])
        np.maximum.at(counts[part], found.sample, _inliers(found, data))
    best = np.maximum.accumulate(counts.reshape(runs, length), axis=1)
    mean: FloatArray = best.mean(axis=0) / len(data)
    return mean


def _inliers(found: Solutions, data: Measurements) -> FloatArray:
    """Number of matches within the threshold, of each solution (M,)."""
    result = np.zeros(len(found))
    possible = np.flatnonzero(plausible(found, corner_radius=1.0))
    for part in np.array_split(possible, max(1, len(possible) // 100)):
        errors2 = transfer_errors2(found.homography[part], found.distortion[part], data)
        result[part] = (errors2 < _THRESHOLD**2).sum(axis=1)
    return result


def _table(pair: MatchedPair, found: Sequence[_Curve], runs: int) -> Table:
    rows = tuple((c.solver, *(100.0 * float(c.share[k - 1]) for k in ITERATIONS)) for c in found)
    count = len(pair.points1)
    title = f"Fig. 7: {pair.name}: inliers within {_THRESHOLD:g} px, % of {count} matches, mean of {runs} runs"
    return Table(title, ("solver", *(f"{k} it." for k in ITERATIONS)), rows)
