"""The minimal solvers that the figures compare, those of other libraries too, and their errors under noise."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from examples.paper.common.report import Table, curves
from examples.worlds.instances import PlanarInstances, lift
from rdstitch import solvers
from rdstitch.arrays import FloatArray
from rdstitch.solvers import Solutions


def optional_module(name: str) -> Any | None:
    """A module, or None where it is not installed."""
    try:
        return import_module(name)
    except ModuleNotFoundError:
        return None


def absent(*names: str) -> tuple[str, ...]:
    """A note for each of the modules that is not installed."""
    return tuple(f"{name} is not installed and was left out" for name in names if optional_module(name) is None)


def homlib_solver(name: str, *arguments: bool) -> Callable[[FloatArray, FloatArray], Solutions] | None:
    """A minimal solver of homlib with rdstitch's calling convention, or None where homlib is not installed.

    It is called once a sample, as homlib has no batches.
    """
    homlib = optional_module("homlib")
    if homlib is None:
        return None
    estimate = getattr(homlib, name)

    def solve(x1: FloatArray, x2: FloatArray) -> Solutions:
        columns = np.ascontiguousarray(np.swapaxes(np.stack([x1, x2]), -1, -2))
        # Of noisy points its solvers sometimes return a homography of NaN.
        found = [
            [model for model in estimate(a, b, *arguments) if np.isfinite(model.homography).all()]
            for a, b in zip(*columns, strict=True)
        ]
        counts = [len(models) for models in found]
        models = [model for own in found for model in own]
        return Solutions(
            np.repeat(np.arange(len(found)), counts),
            np.array([model.homography for model in models]).reshape(-1, 3, 3),
            np.array([model.distortion_parameter for model in models]).reshape(-1),
        )

    return solve


HOMLIB: tuple[tuple[str, str, tuple[bool, ...]], ...] = (
    ("5 points, Fitzgibbon (homlib)", "estimate_fitzgibbon_cvpr_2001_two_sided_equal", ()),
    ("5 points, Wadenbäck (homlib)", "estimate_wadenback_3dv_2026_two_sided_equal", (False,)),
)
"""Solvers of homlib for one λ in both images: name, function, further arguments."""


@dataclass(frozen=True)
class Contender:
    """A minimal solver.

    ``solve``: takes the points of the instances (B, points, 2), both images, and their true tilts (B, 2), which only
    solvers for a known tilt look at.
    """

    name: str
    points: int  # correspondences that it needs
    solve: Callable[[FloatArray, FloatArray, FloatArray], Solutions]

    def __call__(self, instances: PlanarInstances) -> Solutions:
        """Solve all instances."""
        k = self.points
        return self.solve(instances.x1[:, :k], instances.x2[:, :k], instances.tilt)


def known_tilt() -> list[Contender]:
    """Solvers that are told the tilt."""
    return [
        Contender("2 points", 2, lambda a, b, tilt: solvers.two_point(a, b, _per_image(tilt))),
        Contender(
            "3 points, height free", 3, lambda a, b, tilt: solvers.three_point_similarity(a, b, _per_image(tilt))
        ),
    ]


def own_unknown_tilt() -> list[Contender]:
    """Our solvers that are not told the tilt."""
    return [
        Contender("3 points", 3, lambda a, b, _: solvers.three_point(a, b)),
        Contender("4 points", 4, lambda a, b, _: solvers.four_point(a, b)),
        Contender("5 points", 5, lambda a, b, _: solvers.five_point(a, b)),
    ]


def homlib_contenders() -> list[Contender]:
    """Solvers of homlib; none where it is not installed."""
    found = []
    for name, function, arguments in HOMLIB:
        solve = homlib_solver(function, *arguments)
        if solve is not None:
            found.append(Contender(name, 5, lambda a, b, _, solve=solve: solve(a, b)))  # type: ignore[misc]
    return found


def unknown_tilt() -> list[Contender]:
    """Solvers that are not told the tilt, ours and, where it is installed, homlib's."""
    return own_unknown_tilt() + homlib_contenders()


def _per_image(tilt: FloatArray) -> FloatArray:
    """The same tilt (B, 2) for both images of a sample; shape (B, 2, 2)."""
    return np.repeat(tilt[:, None, :], 2, axis=1)


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

    def tables(self, figure: str, about: str) -> tuple[Table, ...]:
        """One for each of the three."""
        return (
            self.table(f"{figure}: median error of λ of the solution nearest to the truth, {about}", "nearest"),
            self.table(f"{figure}: median error of λ of the solution that {WITNESSES} more points choose", "chosen"),
            self.table(f"{figure}: median error of H of the solution nearest to the truth", "homography"),
        )

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
