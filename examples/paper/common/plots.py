"""The plots that several figures share, on matplotlib Figures without global state."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from examples.paper.common.peers import optional_module

_MARKED = 20


def new_figure() -> Any | None:
    """An empty Figure, or None where matplotlib is not installed."""
    module = optional_module("matplotlib.figure")
    return None if module is None else module.Figure(figsize=(9.6, 4.0), layout="constrained")


def histograms(axes: Any, samples: Mapping[str, ArrayLike], label: str) -> None:
    """Outlined histograms of log10 of positive samples; what is 0 or not finite is put at the edges."""
    bins = np.linspace(-17.0, 1.0, 73)
    for name, values in samples.items():
        with np.errstate(divide="ignore"):
            logs = np.clip(np.log10(np.asarray(values, dtype=np.float64)), bins[0], bins[-1])
        axes.hist(logs, bins=bins, weights=np.full(len(logs), 1.0 / len(logs)), histtype="step", label=name)
    axes.set_xlabel(label)
    axes.set_ylabel("share of instances")
    axes.set_yscale("log")
    axes.legend(fontsize=7)


def curves(
    axes: Any, x: ArrayLike, series: Mapping[str, Sequence[float]], xlabel: str, ylabel: str, *, log: bool = False
) -> None:
    """One line a series over common abscissae; places are marked where there are few."""
    marker = "." if np.size(x) <= _MARKED else ""
    for name, values in series.items():
        axes.plot(x, values, marker=marker, label=name)
    if log:
        axes.set_yscale("log")
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
