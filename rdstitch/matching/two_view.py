"""Registration of pairs: match the features of two images, estimate homography and λ together.

The tasks of both stages are batches of pairs, for any :class:`concurrent.futures.Executor`: they take names of features
and matches, which lie in the cache of the run, and give names back.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from threading import Lock
from typing import NamedTuple

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.features import Correspondences, Features, Matcher, match_overlap
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.feature_store import StoredFeatures, StoredMatches
from rdstitch.matching.links import Link
from rdstitch.robust import EstimationOptions, PairMatches, estimate_radial_homographies
from rdstitch.system.cache import Cache
from rdstitch.system.process_memory import return_freed_memory

Pair = tuple[int, int]

Transfer = Callable[[int, int, FloatArray], FloatArray]
"""Takes two images and points (N, 2) of the first, pixels, to points of the second; NaN where it does not see them."""

PAIRS_ESTIMATED_AT_ONCE = 128
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

    @property
    def pairwise_errors(self) -> FloatArray:
        """How far each match, (M,), is from where the relation of the pair expects it, pixels."""
        return self.errors(lambda _first, _second, points: self.relation.transfer(points))

    def link(self) -> Link:
        """The inliers, as global adjustment takes them."""
        inliers = self.relation.inliers
        matched = self.correspondences
        return Link(self.image1, self.image2, matched.points1[inliers], matched.points2[inliers], self.relation)


class MatchingTask(NamedTuple):
    """A pair to be matched."""

    features1: StoredFeatures
    features2: StoredFeatures
    known: StoredMatches | None  # some matches: others are looked for only where these show that the images overlap


def match_pairs(
    tasks: Sequence[MatchingTask], *, matcher: Matcher, matcher_key: tuple[float | str | None, ...], cache: Cache
) -> list[StoredMatches]:
    """Match the features of pairs; the key stands for the matcher in the inputs of results."""
    return_freed_memory()  # what detection has kept
    # Pairs that follow one another have an image in common, and the next ones its neighbours: a megabyte each.
    load = lru_cache(maxsize=8)(StoredFeatures.load)
    result = []
    for one, two, known in tasks:
        inputs = (one.key(cache), two.key(cache), matcher_key, None if known is None else known.key(cache))
        stored = cache.stored("matches", inputs, partial(_matched, matcher, load, one, two, known))
        result.append(StoredMatches(stored, len(stored.load())))
    return result


def _matched(
    matcher: Matcher,
    load: Callable[[StoredFeatures], Features],
    one: StoredFeatures,
    two: StoredFeatures,
    known: StoredMatches | None,
) -> Correspondences:
    if known is None:
        return matcher(load(one), load(two))
    return match_overlap(matcher, load(one), load(two), known.load())


Tilt = tuple[float, float]
"""(ψ, θ), radians."""


class EstimationTask(NamedTuple):
    """A pair to be estimated."""

    camera1: Camera
    camera2: Camera
    matches: StoredMatches
    tilt1: Tilt | None  # where it is known exactly
    tilt2: Tilt | None

    def pair_matches(self) -> PairMatches:
        """The matches as estimation takes them."""
        putative = self.matches.load()
        known = None if self.tilt1 is None or self.tilt2 is None else np.array([self.tilt1, self.tilt2])
        return PairMatches(putative.points1, putative.points2, self.camera1, self.camera2, -putative.ratio, known)


def estimate_pairs(
    tasks: Sequence[EstimationTask], *, options: EstimationOptions, cache: Cache
) -> list[RadialHomography]:
    """Estimate the two-view geometry of pairs, in lockstep."""
    inputs = [(k.camera1, k.camera2, k.matches.key(cache), options, k.tilt1, k.tilt2) for k in tasks]

    def estimate(places: list[int]) -> list[RadialHomography]:
        pairs = [tasks[k].pair_matches() for k in places]
        with _one_estimation:
            return estimate_radial_homographies(pairs, options)

    return cache.recall_many("pairs", inputs, estimate)
