"""Which pictures come from which lens, where those of two lenses or two zoom settings are mixed.

A pair of pictures sees λ of both of them, each on its own: the same one where they come from one lens. So a division of
the pictures into two lenses predicts what every pair sees.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.camera import Camera, FloatArray
from rdstitch.registration.observations import IntArray, spread_choice
from rdstitch.registration.pairs import PairRegistration
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.own_lenses import OwnLenses, own_lenses

BoolArray = NDArray[np.bool_]

_FARTHEST = 10.0  # thresholds from where one λ puts them, within which correspondences may fit with two
_MOST = 250  # correspondences of a pair that are asked
_STARTS = 5  # quantiles of the votes that the two λ are looked for from
_ROUNDS = 6
_MOVES = 12
_LEAST_STD = 2e-4  # λ; no pair knows it better than that the division model holds
_COMMON_STD = 0.05  # λ; by so much relief and lenses of another kind change what a pair sees, of both pictures alike
_LEAST_GAP = 0.01  # λ; what is nearer is one lens that one λ does not quite describe
_LEAST_GAP_PX = 8.0  # the same at a corner, px; with one λ, pictures are then off by a tenth of that
_MEAN_MISS = 1.25  # standard deviations that a vote, two numbers, is off on average; less is luck
# How many times better two lenses must explain the votes than one: at least, and times one over the number of votes.
_LEAST_GAIN, _GAIN_OF_FEW = 4.0, 4.0
_LEAST_MARGIN = 5.0  # standard deviations by which votes must tell of which of the two lenses a picture is


@dataclass(frozen=True)
class Votes:
    """What pairs see of λ, each on its own.

    Attributes
    ----------
    image1, image2 : ndarray of shape (L,), intp
        The pictures of each pair.
    distortion : ndarray of shape (L, 2)
        λ of its first and of its second picture, half-diagonal frame.
    covariance : ndarray of shape (L, 2, 2)
    """

    image1: IntArray
    image2: IntArray
    distortion: FloatArray
    covariance: FloatArray

    @classmethod
    def of(cls, pairs: Sequence[PairRegistration], threshold: float) -> Self:
        """The votes of the pairs that see λ; ``threshold``, px, as they were estimated with."""
        asked = [pair for pair in pairs if pair.relation and np.isfinite(pair.relation.distortion_std)]
        found = [(pair, _vote(pair, threshold)) for pair in asked]
        seen = [(pair, vote) for pair, vote in found if np.isfinite(vote.covariance).all()]
        return cls(
            np.array([pair.image1 for pair, _ in seen], dtype=np.intp),
            np.array([pair.image2 for pair, _ in seen], dtype=np.intp),
            np.array([vote.distortion for _, vote in seen]).reshape(-1, 2),
            np.array([vote.covariance for _, vote in seen]).reshape(-1, 2, 2),
        )

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.image1)

    def missed(self, expected: FloatArray | float) -> FloatArray:
        """How far each vote is from what is expected, (L, 2), in its standard deviations."""
        return np.asarray(np.linalg.norm(self._whitened(self.distortion - expected), axis=1))

    def seen(self, count: int) -> BoolArray:
        """Which of ``count`` pictures have a part in a vote."""
        return np.isin(np.arange(count), [self.image1, self.image2])

    def which(self, second: BoolArray) -> IntArray:
        """From which lens, 0 or 1, the two pictures of each pair come, shape (L, 2)."""
        return np.stack([second[self.image1], second[self.image2]], axis=1).astype(np.intp)

    def fitted(self, which: IntArray, lenses: FloatArray) -> FloatArray:
        """λ of the lenses that the votes miss by the least, by reweighted least squares.

        Parameters
        ----------
        which : ndarray of shape (L, 2), intp
            The lens of each picture of each pair.
        lenses : ndarray of shape (K,)
            λ to start from; that of a lens without votes stays.
        """
        design = self._whitening @ np.eye(len(lenses))[which]
        seen = np.bincount(which.ravel(), minlength=len(lenses)) > 0
        for _ in range(_ROUNDS):
            weight = 1.0 / np.maximum(self.missed(lenses[which]), 0.1)
            normal = np.einsum("l,lij,lik->jk", weight, design, design)
            right = np.einsum("l,lij,li->j", weight, design, self._whitened(self.distortion))
            lenses = np.where(seen, np.linalg.lstsq(normal, right, rcond=None)[0], lenses)
        return lenses

    @cached_property
    def _whitening(self) -> FloatArray:
        """W (L, 2, 2), with W'W the inverse of each covariance."""
        covariance = self.covariance + _LEAST_STD**2 * np.eye(2) + _COMMON_STD**2
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))

    def _whitened(self, values: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("lij,lj->li", self._whitening, values))


def _vote(pair: PairRegistration, threshold: float) -> OwnLenses:
    """λ of both pictures, from what lies not too far from where one λ puts it."""
    relation, matched = pair.relation, pair.correspondences
    apart = np.linalg.norm(relation.transfer(matched.points1) - matched.points2, axis=1)
    near = np.flatnonzero(apart < _FARTHEST * threshold)
    near = near[spread_choice(matched.points1[near], _MOST)]
    points1, points2 = matched.points1[near], matched.points2[near]
    data = Measurements.from_pixels(points1, points2, relation.camera, relation.camera2, None)
    return own_lenses(relation, data, threshold)


@dataclass(frozen=True)
class TwoLenses:
    """Pictures of two lenses.

    Attributes
    ----------
    second : ndarray of shape (N,), bool
        Which pictures come from the second one: the fewer.
    distortion : (float, float)
        λ of both, half-diagonal frame.
    certain : bool
        Whether it is clear which pictures belong together, and a pair of them can be stitched.
    """

    second: BoolArray
    distortion: tuple[float, float]
    certain: bool


def two_lenses(cameras: Sequence[Camera], votes: Votes) -> TwoLenses | None:
    """The division of pictures into two lenses that the votes speak for; None where one lens will do.

    Relief and lenses that one λ does not describe scatter the votes by many times their standard deviations, and a few
    scattered votes can always be divided somehow. Two lenses must therefore explain the votes that the second one has
    a part in far better than one lens does, the more so the fewer there are; and they must differ by enough to be seen
    in the result.

    Parameters
    ----------
    cameras : sequence of Camera
        One a picture; only their sizes are used.
    votes : Votes
    """
    if not len(votes):
        return None
    one = votes.fitted(np.zeros((len(votes), 2), dtype=np.intp), np.median(votes.distortion, keepdims=True)[0])
    missed = votes.missed(one)
    if missed.max() < _LEAST_GAIN * _MEAN_MISS:
        return None
    second, lenses = _best_division(len(cameras), votes)
    which = votes.which(second)
    involved = which.any(axis=1)
    number, left = int(involved.sum()), votes.missed(lenses[which])
    least = max(float(left[involved].sum()), max(_MEAN_MISS, float(left.mean())) * number)
    if not number or missed[involved].sum() < (_LEAST_GAIN + _GAIN_OF_FEW / number) * least:
        return None
    if abs(lenses[1] - lenses[0]) < max(_LEAST_GAP, _LEAST_GAP_PX / min(camera.half_diagonal for camera in cameras)):
        return None
    told = _margins(len(cameras), votes, second, lenses)[votes.seen(len(cameras))].min() >= _LEAST_MARGIN
    return TwoLenses(second, (float(lenses[0]), float(lenses[1])), bool(told and (which[:, 0] == which[:, 1]).any()))


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


def _best_division(count: int, votes: Votes) -> tuple[BoolArray, FloatArray]:
    """The pictures of the second lens, which has the fewer, and λ of both: those that the votes miss by the least."""
    ends = np.unique(np.quantile(votes.distortion, np.linspace(0.0, 1.0, _STARTS)))
    divisions = [_divide(count, votes, np.array(start)) for start in itertools.combinations(ends, 2)]
    second, lenses = min(divisions, key=lambda division: votes.missed(division[1][votes.which(division[0])]).sum())
    seen = votes.seen(count)
    if 2 * second[seen].sum() > seen.sum():
        second, lenses = ~second, lenses[::-1]
    return second & seen, lenses  # of a picture without votes nothing is known that would tell it from most others


def _divide(count: int, votes: Votes, lenses: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Pictures and λ of two lenses, in turn, from a first guess of λ."""
    second = _first_division(count, votes, lenses)
    for _ in range(_ROUNDS):
        second = _improved_division(count, votes, second, lenses)
        previous, lenses = lenses, votes.fitted(votes.which(second), lenses)
        if np.allclose(lenses, previous, atol=1e-6):
            break
    return second, lenses


def _first_division(count: int, votes: Votes, lenses: FloatArray) -> BoolArray:
    """To which lens each picture belongs by its own votes, whatever the pictures beside it are."""
    missed = np.array([[votes.missed(np.array([first, last])) for last in lenses] for first in lenses])
    costs = [_per_picture(count, votes, missed[k].min(axis=0), missed[:, k].min(axis=0)) for k in (0, 1)]
    return np.asarray(costs[1] < costs[0])


def _improved_division(count: int, votes: Votes, second: BoolArray, lenses: FloatArray) -> BoolArray:
    """The division after moving those pictures to the other lens by which the votes gain most, some at a time."""
    for _ in range(_MOVES):
        margin = _margins(count, votes, second, lenses)
        if margin.min() >= -1e-9:
            break
        second = second ^ (margin < min(0.5 * margin.min(), -1e-9))
    return second


def _margins(count: int, votes: Votes, second: BoolArray, lenses: FloatArray) -> FloatArray:
    """By how much more the votes were missed if a picture came from the other lens, for each picture (N,)."""
    which = votes.which(second)
    missed = votes.missed(lenses[which])
    return _per_picture(count, votes, *(votes.missed(lenses[which ^ other]) - missed for other in np.eye(2, dtype=int)))


def _per_picture(count: int, votes: Votes, of_first: FloatArray, of_last: FloatArray) -> FloatArray:
    """What the votes say of their first and second pictures, added up, shape (N,)."""
    total: FloatArray = np.zeros(count)
    np.add.at(total, votes.image1, of_first)
    np.add.at(total, votes.image2, of_last)
    return total
