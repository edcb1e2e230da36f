"""Which pictures come from which lens, where those of two lenses or two zoom settings are mixed.

A pair of pictures of one lens sees the λ of that lens; a pair of two lenses, which one λ describes badly, sees about
the mean of both. So a division of the pictures into two lenses predicts what every pair sees.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.camera import FloatArray
from rdstitch.registration.observations import IntArray
from rdstitch.registration.pairs import PairRegistration

BoolArray = NDArray[np.bool_]

_FEWEST_VOTES = 4
_STARTS = 5  # quantiles of the votes that the two λ are looked for from
_ROUNDS = 6
_MOVES = 12
_LEAST_STD = 2e-4  # λ; no pair knows it better than that the division model holds
_LEAST_GAP = 0.01  # λ; what is nearer is one lens that one λ does not quite describe
_LEAST_GAP_IN_SCATTERS = 8.0
_LEAST_MISS = 0.5  # standard deviations on average; less is luck
_STD_PER_MEAN_MISS = 1.25  # of a normal distribution
# How many times better two lenses must explain the votes than one: at least, and times one over the number of votes.
_LEAST_GAIN, _GAIN_OF_FEW = 4.0, 44.0


@dataclass(frozen=True)
class Votes:
    """What pairs see of λ, each on its own.

    Attributes
    ----------
    image1, image2 : ndarray of shape (L,), intp
        The pictures of each pair.
    distortion, std : ndarray of shape (L,)
        λ in the half-diagonal frame, and its standard deviation.
    """

    image1: IntArray
    image2: IntArray
    distortion: FloatArray
    std: FloatArray

    @classmethod
    def of(cls, pairs: Sequence[PairRegistration]) -> Self:
        """The votes of the pairs that see λ."""
        seen = [pair for pair in pairs if pair.relation and np.isfinite(pair.relation.distortion_std)]
        ends = np.array([(pair.image1, pair.image2) for pair in seen], dtype=np.intp).reshape(-1, 2)
        votes = np.array([(pair.relation.distortion, pair.relation.distortion_std) for pair in seen]).reshape(-1, 2)
        return cls(*ends.T, *votes.T)

    def missed(self, expected: FloatArray | float) -> FloatArray:
        """How far each vote is from what is expected, in its standard deviations."""
        return np.abs(self.distortion - expected) / self.std


@dataclass(frozen=True)
class TwoLenses:
    """Pictures of two lenses.

    Attributes
    ----------
    second : ndarray of shape (N,), bool
        Which pictures come from the second one.
    distortion : (float, float)
        λ of both, half-diagonal frame.
    certain : bool
        Whether it is clear which pictures belong together: both lenses have pairs of their own.
    """

    second: BoolArray
    distortion: tuple[float, float]
    certain: bool


def two_lenses(count: int, votes: Votes) -> TwoLenses | None:
    """The division of ``count`` pictures into two lenses that the votes speak for; None where one lens will do.

    Parallax and lenses that one λ does not describe scatter the votes by many times their standard deviations, and a
    few scattered votes can always be divided somehow. Two lenses must therefore explain the votes far better than one,
    the more so the fewer there are.
    """
    votes = Votes(votes.image1, votes.image2, votes.distortion, np.maximum(votes.std, _LEAST_STD))
    number = len(votes.distortion)
    if number < _FEWEST_VOTES:
        return None
    ends = np.unique(np.quantile(votes.distortion, np.linspace(0.0, 1.0, _STARTS)))
    divisions = [_divide(count, votes, np.array(start)) for start in itertools.combinations(ends, 2)]
    second, lenses = min(divisions, key=lambda division: votes.missed(_expected(votes, *division)).sum())
    kinds = _kinds(votes, second)
    gap = float(abs(lenses[1] - lenses[0]))
    missed = max(float(votes.missed(_expected(votes, second, lenses)).sum()), _LEAST_MISS * number)
    scatter = _STD_PER_MEAN_MISS * missed / (number - 2) * float(np.median(votes.std))
    gain = float(votes.missed(_weighted_median(votes.distortion, 1.0 / votes.std)).sum()) / missed
    told = [(kinds < 2).sum() >= 2, (kinds > 0).sum() >= 2, gap >= max(_LEAST_GAP, _LEAST_GAP_IN_SCATTERS * scatter)]
    if not all(told) or gain < _LEAST_GAIN + _GAIN_OF_FEW / number:
        return None
    return TwoLenses(second, (float(lenses[0]), float(lenses[1])), bool((kinds == 0).any() and (kinds == 2).any()))


def pictures_of_the_other(mixed: TwoLenses, pairs: Sequence[PairRegistration]) -> dict[int, str]:
    """Pictures of the lens that took fewer, or has fewer matches, with why they are left out; none if in doubt."""
    if not mixed.certain:
        return {}
    linked = [pair for pair in pairs if pair.relation]
    sizes = []
    for second in (False, True):
        own = [pair for pair in linked if mixed.second[[pair.image1, pair.image2]].tolist() == [second] * 2]
        members = {picture for pair in own for picture in (pair.image1, pair.image2)}
        sizes.append((len(members), sum(int(pair.relation.inliers.sum()) for pair in own)))
    kept = sizes[1] > sizes[0]
    there, here = mixed.distortion[not kept], mixed.distortion[kept]
    reason = (
        f"comes from another lens or zoom setting (λ about {there:.3f}, that of the others {here:.3f}); "
        "stitch those of each on their own"
    )
    return {int(k): reason for k in np.flatnonzero(mixed.second != kept)}


def _divide(count: int, votes: Votes, lenses: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Pictures and λ of two lenses, in turn, from a first guess of λ."""
    second = _first_division(count, votes, lenses)
    for _ in range(_ROUNDS):
        second = _improved_division(count, votes, second, lenses)
        previous, lenses = lenses, _fitted_lenses(votes, second, lenses)
        if np.allclose(lenses, previous, atol=1e-6):
            break
    return second, lenses


def _first_division(count: int, votes: Votes, lenses: FloatArray) -> BoolArray:
    """To which lens each picture belongs by its own votes, whatever the pictures beside it are."""
    mixed = votes.missed(float(lenses.mean()))
    costs = [_per_picture(count, votes, *[np.minimum(votes.missed(float(lens)), mixed)] * 2) for lens in lenses]
    return np.asarray(costs[1] < costs[0])


def _improved_division(count: int, votes: Votes, second: BoolArray, lenses: FloatArray) -> BoolArray:
    """The division after moving those pictures to the other lens by which the votes gain most, some at a time."""
    for _ in range(_MOVES):
        costs = [
            _per_picture(
                count,
                votes,
                votes.missed((lens + lenses[second[votes.image2].astype(int)]) / 2),
                votes.missed((lens + lenses[second[votes.image1].astype(int)]) / 2),
            )
            for lens in lenses
        ]
        gain = np.where(second, costs[1] - costs[0], costs[0] - costs[1])
        if gain.max() <= 1e-9:
            break
        second = second ^ (gain > max(0.5 * gain.max(), 1e-9))
    return second


def _per_picture(count: int, votes: Votes, cost1: FloatArray, cost2: FloatArray) -> FloatArray:
    """What the votes cost their first and second pictures, added up, shape (N,)."""
    total: FloatArray = np.zeros(count)
    np.add.at(total, votes.image1, cost1)
    np.add.at(total, votes.image2, cost2)
    return total


def _fitted_lenses(votes: Votes, second: BoolArray, lenses: FloatArray) -> FloatArray:
    """λ of both lenses that miss the votes by the least, by reweighted least squares."""
    share = _kinds(votes, second) / 2.0
    if share.min() == share.max():
        return lenses
    design = np.column_stack([1.0 - share, share])
    for _ in range(_ROUNDS):
        weight = 1.0 / np.maximum(votes.missed(design @ lenses), 0.1) / votes.std**2
        normal = design.T @ (weight[:, None] * design)
        lenses = np.asarray(np.linalg.lstsq(normal, design.T @ (weight * votes.distortion), rcond=None)[0])
    return lenses


def _kinds(votes: Votes, second: BoolArray) -> IntArray:
    """How many of the pictures of each pair come from the second lens."""
    return second[votes.image1].astype(np.intp) + second[votes.image2]


def _expected(votes: Votes, second: BoolArray, lenses: FloatArray) -> FloatArray:
    """What each pair should see."""
    share = _kinds(votes, second) / 2.0
    return np.asarray((1.0 - share) * lenses[0] + share * lenses[1])


def _weighted_median(values: FloatArray, weight: FloatArray) -> float:
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(cumulative, cumulative[-1] / 2)])
