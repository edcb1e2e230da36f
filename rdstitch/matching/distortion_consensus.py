"""λ by consensus: every pair votes, weighted by what it can know (Valtonen Örnhag et al., §5.5).

The paper takes the peak of a histogram of the pairs' λ. Here the votes are weighted by their covariance, to which
the scatter between pairs is added that the covariances do not explain; the histogram is kept for the report.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.robust.loss import NORMAL_MEDIAN

_BINS = 50  # of the histogram, for the report alone
_ROUNDS = 20  # of reweighting; three or four are needed


@dataclass(frozen=True, eq=False)
class Consensus:
    """What the pairs agree on."""

    distortion: float  # λ in the half-diagonal frame; NaN where no pair can see it
    std: float  # its standard deviation; inf where no pair can see it
    scatter: float  # standard deviation between pairs that their own uncertainty does not explain
    agreeing: int  # votes within three standard deviations of the consensus
    votes: int  # pairs that can see λ
    edges: FloatArray  # (B + 1,): bin edges of the histogram; empty without votes
    histogram: FloatArray  # (B,): weight of the votes in each bin, adding up to one
    reason: str  # one sentence


def vote(distortion: ArrayLike, std: ArrayLike) -> Consensus:
    """The λ that the pairs agree on.

    ``distortion`` (L,): λ of each pair; ``std`` (L,): its standard deviation; pairs with a value that is not finite
    have no vote.
    """
    values, errors = np.asarray(distortion, dtype=np.float64), np.asarray(std, dtype=np.float64)
    count = len(values)
    able = np.isfinite(values) & np.isfinite(errors)
    values, errors = values[able], np.maximum(errors[able], 1e-6)
    if not len(values):
        reason = f"none of {count} pairs can see the distortion: the camera hardly moves, or only turns about its axis"
        empty = np.empty(0)
        return Consensus(np.nan, np.inf, 0.0, 0, 0, empty, empty, reason)
    scatter = 0.0
    center = _weighted_median(values, errors**-2)
    for _ in range(_ROUNDS):
        total = np.hypot(errors, scatter)
        inside = np.abs(values - center) <= 3.0 * total
        weight = inside / total**2
        if not inside.any():
            break
        center = float(weight @ values / weight.sum())
        scatter = _scatter(values - center, errors)
    total = np.hypot(errors, scatter)
    inside = np.abs(values - center) <= 3.0 * total
    weight = np.where(inside, total**-2.0, 0.0)
    uncertainty = float(1.0 / np.sqrt(max(weight.sum(), 1e-300)))
    low, high = min(values.min(), center - 1e-3), max(values.max(), center + 1e-3)
    histogram, edges = np.histogram(values, bins=_BINS, range=(low, high), weights=total**-2.0)
    reason = f"{int(inside.sum())} of {len(values)} pairs agree on {center:+.4f}"
    return Consensus(
        center,
        uncertainty,
        scatter,
        int(inside.sum()),
        len(values),
        edges,
        histogram / histogram.sum(),
        reason,
    )


def _weighted_median(values: FloatArray, weight: FloatArray) -> float:
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(cumulative, cumulative[-1] / 2)])


def _scatter(residual: FloatArray, errors: FloatArray) -> float:
    """The additional standard deviation that makes the median of the normalized residuals what it should be."""
    if len(residual) < 3:
        return 0.0
    # Where the median of some ratios of squares is a number, that of the differences times it is zero.
    return float(np.sqrt(max(np.median((residual / NORMAL_MEDIAN) ** 2 - errors**2), 0.0)))
