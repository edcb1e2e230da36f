"""What pairs of images see of λ, of each of their two images on its own."""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import chain
from typing import Self

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.executors import batches, in_order
from rdstitch.matching.links import grid_subsample
from rdstitch.matching.two_view import PairRegistration
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.per_image_distortion import PerImageDistortion, estimate_per_image_distortion
from rdstitch.system.late_imports import sparse, sparse_linalg

_MAX_DISTANCE = 10.0  # thresholds from where one λ puts them, within which correspondences may fit with two
_MAX_MATCHES = 250  # matches of a pair that are used
_MIN_STD = 2e-4  # λ; no pair knows it better than that the division model holds
_MIN_INLIERS = 30  # of a pair that votes: three times the parameters of a homography and two λ
_COMMON_STD = 0.05  # λ; by so much relief and lenses of another kind change what a pair sees, of both images alike
_MAX_COHERENCE = 0.5  # correlation of neighbours' errors: more is depth, for which λ of either image takes the blame
_REWEIGHTINGS = 6  # rounds of reweighting, which lead to the median
_LEAST_RESIDUAL = 0.1  # standard deviations below which all votes count alike
_PAIRS_AT_ONCE = 64


@dataclass(frozen=True, eq=False)
class LensVotes:
    """What pairs see of λ, each on its own."""

    image1: IntArray  # image1, image2: (L,), intp: the images of each pair
    image2: IntArray
    distortion: FloatArray  # (L, 2): λ of its first and of its second image, half-diagonal frame
    covariance: FloatArray  # (L, 2, 2)

    @classmethod
    def of(cls, pairs: Sequence[PairRegistration], threshold: float, executor: Executor) -> Self:
        """The votes of the pairs that see λ; ``threshold``, pixels, as they were estimated with."""
        registered = [
            pair
            for pair in pairs
            if pair.relation
            and np.isfinite(pair.relation.distortion_std)
            and int(pair.relation.inliers.sum()) >= _MIN_INLIERS
        ]
        estimate = partial(_per_image_distortions, threshold)
        votes = chain.from_iterable(in_order(executor, estimate, batches(registered, _PAIRS_AT_ONCE)))
        seen = [
            (pair, vote)
            for pair, vote in zip(registered, votes, strict=True)
            if np.isfinite(vote.covariance).all() and vote.coherence < _MAX_COHERENCE
        ]
        return cls(
            np.array([pair.image1 for pair, _ in seen], dtype=np.intp),
            np.array([pair.image2 for pair, _ in seen], dtype=np.intp),
            np.array([vote.distortion for _, vote in seen]).reshape(-1, 2),
            np.array([vote.covariance for _, vote in seen]).reshape(-1, 2, 2),
        )

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.image1)

    def mahalanobis_residuals(self, expected: FloatArray | float) -> FloatArray:
        """How far each vote is from what is expected, (L, 2), in its standard deviations."""
        whitened = np.einsum("lij,lj->li", self._whitening, self.distortion - expected)
        return np.asarray(np.linalg.norm(whitened, axis=1))

    def lens_index(self, second: BoolArray) -> IntArray:
        """The lens, 0 or 1, that each of the two images of each pair comes from, shape (L, 2)."""
        return np.stack([second[self.image1], second[self.image2]], axis=1).astype(np.intp)

    def fitted(self, lens_index: IntArray, lenses: FloatArray) -> FloatArray:
        """λ of the lenses that the votes miss by the least, by reweighted least squares.

        ``lens_index`` (L, 2): the lens of each image of each pair; ``lenses`` (K,): λ to start from; that of a lens
        without votes stays.
        """
        count, every = len(lenses), np.arange(len(lenses))
        both = np.broadcast_arrays(lens_index[:, :, None], lens_index[:, None, :])
        places = tuple(np.concatenate([lens.ravel(), every]) for lens in both)
        information = np.swapaxes(self._whitening, 1, 2) @ self._whitening
        votes = np.einsum("lij,lj->li", information, self.distortion)
        unseen = np.bincount(lens_index.ravel(), minlength=count) == 0
        for _ in range(_REWEIGHTINGS):
            # The median, whatever it starts from: a loss that forgets far votes would settle on one of two lenses.
            weight = 1.0 / np.maximum(self.mahalanobis_residuals(lenses[lens_index]), _LEAST_RESIDUAL)
            entries = np.concatenate([(information * weight[:, None, None]).ravel(), unseen])
            normal = sparse.coo_array((entries, places), shape=(count, count)).tocsc()
            right = np.bincount(lens_index.ravel(), (votes * weight[:, None]).ravel(), count)
            lenses = np.where(unseen, lenses, sparse_linalg.splu(normal).solve(right))
        return lenses

    @cached_property
    def _whitening(self) -> FloatArray:
        """W (L, 2, 2), with W'W the inverse of each covariance."""
        covariance = self.covariance + _MIN_STD**2 * np.eye(2) + _COMMON_STD**2
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def _per_image_distortions(threshold: float, pairs: Sequence[PairRegistration]) -> list[PerImageDistortion]:
    """λ of both images of each pair, from what lies not too far from where one λ puts it."""
    points = [_matches_near_one_lens(pair, threshold) for pair in pairs]
    cameras = [(pair.relation.camera, pair.relation.camera2) for pair in pairs]
    relations = [pair.relation for pair in pairs]
    return estimate_per_image_distortion(relations, Measurements.of_pairs(points, cameras), threshold)


def _matches_near_one_lens(pair: PairRegistration, threshold: float) -> tuple[FloatArray, FloatArray]:
    """Matches not too far from where one λ puts them, evenly spread, pixels."""
    matched = pair.correspondences
    error = np.linalg.norm(pair.relation.transfer(matched.points1) - matched.points2, axis=1)
    near = np.flatnonzero(error < _MAX_DISTANCE * threshold)
    near = near[grid_subsample(matched.points1[near], _MAX_MATCHES)]
    return matched.points1[near], matched.points2[near]
