"""Fig. 7: inliers against RANSAC iterations, averaged over many runs, for every solver."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from examples.paper.common.contenders import absent
from examples.paper.common.matched import MatchedPair, match_files, match_rendered, rendered_pair
from examples.paper.common.plain_ransac import THRESHOLD, all_solvers, draw_samples
from examples.paper.common.report import Effort, Report, Settings, Table, curves
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.minimal import MinimalSolver

ITERATIONS = (1, 2, 5, 10, 20, 50, 100, 200)
"""At which the inliers are reported."""

_RATIO = 0.95  # of the matches: loose, so that there is something to do
_RENDERED_TILT = (0.05, -0.04)
_RUNS_AT_ONCE = 5


@dataclass(frozen=True)
class _Curve:
    """Mean share of inliers (iterations,) of one solver."""

    solver: str
    share: FloatArray


def run(settings: Settings) -> Report:
    """Mean share of inliers of the best model after so many iterations."""
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
        notes += ("the real images garfield_red are not here and were left out",)
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
    data = Measurements.from_pixels(pair.points1, pair.points2, pair.camera, pair.camera)
    return [_Curve(s.name, _mean_share(s, data, runs)) for s in all_solvers(pair.camera, pair.tilt)]


def _mean_share(solver: MinimalSolver, data: Measurements, runs: int) -> FloatArray:
    """Mean over the runs of the share of inliers of the best model so far, shape (iterations,)."""
    length = ITERATIONS[-1]
    total = np.zeros(length)
    for first in range(0, runs, _RUNS_AT_ONCE):
        together = min(_RUNS_AT_ONCE, runs - first)
        found, inliers = draw_samples(solver, data, together * length, seed=first)
        counts = np.zeros(together * length)
        np.maximum.at(counts, found.sample, inliers)
        total += np.maximum.accumulate(counts.reshape(together, length), axis=1).sum(axis=0)
    share: FloatArray = total / (runs * int(data.count[0]))
    return share


def _table(pair: MatchedPair, found: Sequence[_Curve], runs: int) -> Table:
    rows = tuple((c.solver, *(100.0 * float(c.share[k - 1]) for k in ITERATIONS)) for c in found)
    count = len(pair.points1)
    title = f"Fig. 7: {pair.name}: inliers within {THRESHOLD:g} px, % of {count} matches, mean of {runs} runs"
    return Table(title, ("solver", *(f"{k} it." for k in ITERATIONS)), rows)
