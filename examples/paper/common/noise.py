"""Errors of minimal solvers against the noise of the points: what Fig. 3 and Fig. 4 share."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from examples.paper.common.contenders import Contender
from examples.paper.common.plots import curves
from examples.paper.common.report import Table
from rdstitch.arrays import FloatArray
from rdstitch.radial_homography import lift
from rdstitch.solvers import Solutions
from tests.instances import PlanarInstances

SIGMAS = (0.05, 0.1, 0.25, 0.5, 1.0, 2.0)
"""Standard deviations of the noise in px of a 640 x 480 image."""

HALF_DIAGONAL = 400.0
"""Of that image, px, and its focal length, so that λ is the same in both frames."""

WITNESSES = 20
"""Further points, with the same noise, that choose among the solutions of a sample, as RANSAC does."""


@dataclass(frozen=True)
class NoiseSweep:
    """Median errors of several solvers; each array has shape (noise levels,)."""

    nearest: dict[str, FloatArray]  # ``|λ - λ_true|`` of the solution nearest to the truth
    chosen: dict[str, FloatArray]  # the same of the solution that the witnesses choose
    homography: dict[str, FloatArray]  # distance of the nearest solution's H

    def table(self, title: str, what: str) -> Table:
        """One of the three as a table with a column a noise level."""
        rows = tuple((name, *map(float, values)) for name, values in getattr(self, what).items())
        return Table(title, ("solver", *(f"σ = {sigma:g} px" for sigma in SIGMAS)), rows)

    def draw(self, figure: Any) -> None:
        """Both errors of λ, and that of H."""
        labels = ("λ, nearest solution", "λ, solution chosen by the data", "H, nearest solution")
        parts = (self.nearest, self.chosen, self.homography)
        for axes, series, label in zip(figure.subplots(1, 3), parts, labels, strict=True):
            lists = {name: values.tolist() for name, values in series.items()}
            curves(axes, SIGMAS, lists, "σ, px", f"median error of {label}", log=True)
            axes.set_xscale("log")


def sweep(contenders: Sequence[Contender], draw: Callable[[float, int], PlanarInstances]) -> NoiseSweep:
    """Solve instances at every noise level.

    ``draw``: gives instances of 5 + ``WITNESSES`` points for a noise, focal lengths, and a seed.
    """
    result = NoiseSweep({}, {}, {})
    for level, sigma in enumerate(SIGMAS):
        instances = draw(sigma / HALF_DIAGONAL, level)
        for contender in contenders:
            solutions = contender(instances)
            lam, h = instances.best_errors(solutions)
            best = _chosen(instances, solutions)
            for errors, values in (
                (result.nearest, lam),
                (result.homography, h),
                (result.chosen, instances.best_errors(best)[0]),
            ):
                errors.setdefault(contender.name, np.full(len(SIGMAS), np.nan))[level] = np.median(values)
    return result


def _chosen(instances: PlanarInstances, solutions: Solutions) -> Solutions:
    """Of each sample the solution with the smallest median transfer error of the witnesses."""
    x1, x2 = (x[solutions.sample, -WITNESSES:] for x in (instances.x1, instances.x2))
    lam = solutions.distortion[:, None]
    moved = lift(x1, lam) @ np.swapaxes(solutions.homography, 1, 2)
    measured = lift(x2, lam)
    # Compared where the lens is gone, scaled back to about measured px by the depth of the measured point.
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = (moved[..., :2] / moved[..., 2:] - measured[..., :2] / measured[..., 2:]) * measured[..., 2:]
        error = np.median(np.nan_to_num(np.linalg.norm(offset, axis=2), nan=np.inf), axis=1)
    order = np.lexsort((error, solutions.sample))
    first = order[np.r_[True, np.diff(solutions.sample[order]) > 0]] if len(order) else order
    return Solutions(solutions.sample[first], solutions.homography[first], solutions.distortion[first])
