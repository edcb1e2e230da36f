"""Registration of pairs: match the features of two images, estimate homography and λ together.

The tasks of both stages are batches of pairs, for any :class:`concurrent.futures.Executor`: they take names of features
and matches, which lie in the cache of the run, and give names back.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock
from typing import TypeVar

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.cache import Cache
from rdstitch.camera import Camera
from rdstitch.features import Correspondences, Features, Matcher, match_overlap
from rdstitch.matching.feature_store import StoredFeatures, StoredMatches
from rdstitch.matching.links import Link
from rdstitch.matching.options import PairOptions
from rdstitch.radial_homography import RadialHomography
from rdstitch.robust import PairMatches, estimate_radial_homographies

Item = TypeVar("Item")

Pair = tuple[int, int]

Transfer = Callable[[int, int, FloatArray], FloatArray]
"""Takes two images and points (N, 2) of the first, pixels, to points of the second; NaN where it does not see them."""

_MIN_BATCHES = 8
"""Batches that pairs are at least divided into for matching, so that a few pairs keep several workers busy."""

_PAIRS_MATCHED_AT_ONCE, _PAIRS_ESTIMATED_AT_ONCE = 32, 128
"""Pairs of a task at the most: after so many there is progress to show and to keep."""

_one_estimation = Lock()
"""Small arrays keep the interpreter busy: two threads at it would take half as long again as one after the other."""


@dataclass(frozen=True, repr=False)
class PairRegistration:
    """What became of one pair."""

    image1: int  # image1, image2: indices of the images
    image2: int
    matches: StoredMatches  # the putative matches, on disk
    relation: RadialHomography  # the estimate from ``image1`` to ``image2``; falsy with the reason where there is none

    def __repr__(self) -> str:
        """One line: its images and their relation."""
        return f"<PairRegistration {self.image1}, {self.image2}: {self.relation!r}>"

    @property
    def images(self) -> Pair:
        """Indices of both images."""
        return self.image1, self.image2

    @property
    def correspondences(self) -> Correspondences:
        """The putative matches, pixels; read every time."""
        return self.matches.load()

    def errors(self, transfer: Transfer) -> FloatArray:
        """How far each match, (M,), is from where ``transfer`` expects it, pixels; inf where that is nowhere."""
        matched = self.correspondences
        expected = transfer(self.image1, self.image2, matched.points1)
        return np.asarray(np.nan_to_num(np.linalg.norm(expected - matched.points2, axis=1), nan=np.inf))

    def link(self) -> Link:
        """The inliers, as global adjustment takes them."""
        inliers = self.relation.inliers
        matched = self.correspondences
        return Link(self.image1, self.image2, matched.points1[inliers], matched.points2[inliers], self.relation)


@dataclass(frozen=True)
class MatchingTask:
    """Pairs to be matched together."""

    features: Sequence[tuple[StoredFeatures, StoredFeatures]]  # of the two images of each pair
    # some matches of each pair, where they are known: they show where the images overlap, and only there the rest is
    # looked for
    known: Sequence[StoredMatches | None]
    matcher: Matcher  # matches the features of two images
    how: tuple[float | str | None, ...]  # what stands for the matcher in the inputs of results
    cache: Cache


def match_pairs(task: MatchingTask) -> list[StoredMatches]:
    """Match the features of every pair of a task."""
    # Pairs that follow one another have an image in common.
    load = lru_cache(maxsize=2)(StoredFeatures.load)
    pairs = zip(task.features, task.known, strict=True)
    return [_match_pair(one, two, known, task, load) for (one, two), known in pairs]


def _match_pair(
    one: StoredFeatures,
    two: StoredFeatures,
    known: StoredMatches | None,
    task: MatchingTask,
    load: Callable[[StoredFeatures], Features],
) -> StoredMatches:
    def compute() -> Correspondences:
        if known is None:
            return task.matcher(load(one), load(two))
        return match_overlap(task.matcher, load(one), load(two), known.load())

    cache = task.cache
    inputs = (one.key(cache), two.key(cache), task.how, None if known is None else known.key(cache))
    stored = cache.stored("matches", inputs, compute)
    return StoredMatches(stored, len(stored.load()))


@dataclass(frozen=True)
class EstimationTask:
    """Pairs to be estimated together."""

    # of the two images of each pair; of their lens only the centre and the focal length are used, unless
    # ``options.distortion``
    cameras: Sequence[tuple[Camera, Camera]]
    matches: Sequence[StoredMatches]  # of each pair
    # known tilts (ψ, θ), radians, of the two images of each pair; None where unknown
    tilts: Sequence[tuple[tuple[float, float] | None, tuple[float, float] | None]]
    options: PairOptions
    cache: Cache


def estimate_pairs(task: EstimationTask) -> list[RadialHomography]:
    """Estimate the two-view geometry of every pair of a task, in lockstep."""
    inputs = [
        (*cameras, found.key(task.cache), task.options, *tilts)
        for cameras, found, tilts in zip(task.cameras, task.matches, task.tilts, strict=True)
    ]

    def estimate(places: list[int]) -> list[RadialHomography]:
        pairs = [_pair_matches(task.cameras[k], task.matches[k].load(), task.tilts[k]) for k in places]
        with _one_estimation:
            return estimate_radial_homographies(pairs, task.options.estimation)

    return task.cache.recall_many("pairs", inputs, estimate)


def _pair_matches(
    cameras: tuple[Camera, Camera],
    found: Correspondences,
    tilts: tuple[tuple[float, float] | None, tuple[float, float] | None],
) -> PairMatches:
    """Matches of a pair as estimation takes them."""
    camera = cameras[0]
    own = replace(camera.without_lens(), focal=camera.focal, focal_source=camera.focal_source).with_focal()
    known = None if None in tilts else np.array(tilts, dtype=np.float64)
    other = own.resized(cameras[1].image_size)
    return PairMatches(found.points1, found.points2, own, other, -found.ratio, known)


def matching_batches(items: Sequence[Item]) -> Iterator[Sequence[Item]]:
    """Pairs by the tasks of :func:`match_pairs`."""
    size = min(_PAIRS_MATCHED_AT_ONCE, -(-len(items) // _MIN_BATCHES))
    return (items[start : start + size] for start in range(0, len(items), size or 1))


def estimation_batches(items: Sequence[Item]) -> Iterator[Sequence[Item]]:
    """Pairs that are estimated together, as by a task of :func:`estimate_pairs`."""
    size = _PAIRS_ESTIMATED_AT_ONCE
    return (items[start : start + size] for start in range(0, len(items), size))
