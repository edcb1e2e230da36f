"""Fig. 2: numerical stability. Errors of λ and H of all solvers on noise-free instances."""

from typing import Any

import numpy as np

from examples.paper.common.contenders import absent, known_tilt, unknown_tilt
from examples.paper.common.report import Report, Settings, Table, histograms
from examples.worlds.instances import planar_instances
from rdstitch.arrays import FloatArray

_MISSED = 1e-2


def run(settings: Settings) -> Report:
    """Histograms of log10 of the errors of the solution nearest to the truth."""
    count = settings.count(200, 10_000, 100_000)
    instances = planar_instances(count, 5, seed=2)
    errors: dict[str, tuple[FloatArray, FloatArray]] = {}
    rows = []
    for contender in known_tilt() + unknown_tilt():
        solutions = contender(instances)
        lam, h = errors[contender.name] = instances.best_errors(solutions)
        rows.append((contender.name, *_quantiles(lam), *_quantiles(h)[:2], _missed(lam), len(solutions) / count))
    table = Table(
        f"Fig. 2: log10 of the error, {count} noise-free instances, λ in [-0.7, 0], tilt up to 0.3 rad",
        ("solver", "λ median", "λ 99 %", "λ 99.9 %", "H median", "H 99 %", "λ off by > 0.01, %", "solutions"),
        tuple(rows),
    )

    def draw(figure: Any) -> None:
        left, right = figure.subplots(1, 2, sharey=True)
        histograms(left, {name: pair[0] for name, pair in errors.items()}, "log10 |error of λ|")
        histograms(right, {name: pair[1] for name, pair in errors.items()}, "log10 |error of H|")

    return Report((table,), draw, notes=absent("homlib"))


def _quantiles(error: FloatArray) -> tuple[float, float, float]:
    """Median, 99 % and 99.9 % quantile of log10 of the errors."""
    with np.errstate(divide="ignore"):
        logs = np.log10(error)
    median, high, highest = np.quantile(logs, [0.5, 0.99, 0.999], method="higher")
    return float(median), float(high), float(highest)


def _missed(error: FloatArray) -> float:
    """Percentage of the instances whose true λ is not found."""
    return 100.0 * float(np.mean(~(error < _MISSED)))
