"""λ by consensus: every pair votes, weighted by what it can know (Valtonen Örnhag et al., §5.5).

The paper takes the peak of a histogram of the pairs' λ. Here the votes are weighted by their covariance, to which
the scatter between pairs is added that the covariances do not explain. Far votes count as nothing, since one lens took
the images: where that is the question, :meth:`rdstitch.matching.lens_votes.LensVotes.fitted` counts distances instead.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.numerics.robust_loss import NORMAL_MEDIAN

_ROUNDS = 20  # of reweighting; three or four are needed


@dataclass(frozen=True, eq=False)
class Consensus:
    """What the pairs agree on."""

    distortion: float  # λ in the half-diagonal frame; NaN where no pair can see it
    std: float  # its standard deviation; inf where no pair can see it
    scatter: float  # standard deviation between pairs that their own uncertainty does not explain
    votes: FloatArray  # (V,): λ of the pairs that can see it
    std_of_votes: FloatArray  # (V,): their standard deviations, scatter included
    agreeing: BoolArray  # (V,): those within three standard deviations of the consensus


def vote(distortion: ArrayLike, std: ArrayLike) -> Consensus:
    """The λ that the pairs agree on.

    ``distortion`` (L,): λ of each pair; ``std`` (L,): its standard deviation; pairs with a value that is not finite
    have no vote.
    """
    values, errors = np.asarray(distortion, dtype=np.float64), np.asarray(std, dtype=np.float64)
    able = np.isfinite(values) & np.isfinite(errors)
    values, errors = values[able], np.maximum(errors[able], 1e-6)
    if not len(values):
        return Consensus(np.nan, np.inf, 0.0, values, errors, able[:0])
    # To begin with, no pair outweighs others by being more certain than most.
    weights = np.maximum(errors, np.median(errors)) ** -2
    center, scatter = float(np.quantile(values, 0.5, weights=weights, method="inverted_cdf")), 0.0
    for rounds in range(_ROUNDS + 1):
        total = np.hypot(errors, scatter)
        inside = np.abs(values - center) <= 3.0 * total
        weight = inside / total**2
        if rounds == _ROUNDS or not inside.any():
            break
        center = float(weight @ values / weight.sum())
        if len(values) == 2:  # neither is nearer to the truth: by their difference alone
            unexplained = (np.diff(values)[0] ** 2 - errors @ errors) / 2.0
        else:  # where the median of some ratios of squares is a number, that of the differences times it is zero
            unexplained = np.median(((values - center) / NORMAL_MEDIAN) ** 2 - errors**2)
        scatter = float(np.sqrt(max(unexplained, 0.0)))
    return Consensus(center, float(1.0 / np.sqrt(max(weight.sum(), 1e-300))), scatter, values, total, inside)
