"""Pairs of images through all rounds: matched once, estimated alone, then with what the others know."""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from rdstitch.arrays import evenly_spaced
from rdstitch.executors import batches, in_order
from rdstitch.features import Matcher, match_near
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.candidate_pairs import select_pairs
from rdstitch.matching.feature_store import FeatureStore, StoredMatches
from rdstitch.matching.repeated_pattern import MIN_REPETITION, match_pattern, repetition
from rdstitch.matching.static_background import (
    has_static_background,
    moving_features,
    show_motion,
)
from rdstitch.matching.two_view import (
    PAIRS_ESTIMATED_AT_ONCE,
    Pair,
    PairRegistration,
    Tilt,
    Transfer,
    estimate_pairs,
    match_pairs,
)
from rdstitch.robust import EstimationOptions
from rdstitch.system.cache import NO_CACHE, Cache
from rdstitch.system.progress import Progress

_PAIRS_MATCHED_AT_ONCE, _MIN_BATCHES = 32, 8  # pairs of a task at the most; tasks at the least
_PRESCREEN_FEATURES = 500  # strongest features of an image, by which pairs are prescreened
_MIN_PRESCREEN_MATCHES = 6  # matches among these; images that share nothing have two to five by chance
_MIN_RELATIVE_MATCHES = 0.05  # share of the matches that an image has with the one most like it; less adds nothing
_FEW_INLIERS = 50  # of a pair of a repeated pattern, which shows hundreds of keypoints
_MIN_INLIER_RATIO = 0.7  # of such matches that agree: right pairs have 0.8 to 1, lattices that hardly match half
_SAMPLED = 5  # images that are looked at for a repeated pattern
_SEARCH_RADIUS = 3.0  # thresholds around the place where a match is expected


@dataclass(frozen=True)
class Pairing:
    """What it takes to register pairs."""

    features: FeatureStore
    cameras: Sequence[Camera]
    matcher: Matcher
    estimation: EstimationOptions  # its λ is that of all images, where it is known
    progress: Progress
    executor: Executor  # where batches of pairs are matched and estimated
    cache: Cache = NO_CACHE  # of results of earlier runs
    store: Cache = NO_CACHE  # of what need not be in memory all the time
    ratio: float | None = None  # largest ratio of distances of a match; None: what suits the features
    network: str | Path | None = None  # ONNX file of a network that matches the features instead
    tilts: Sequence[Tilt] | None = None  # (ψ, θ), radians, of each image, where they are known exactly

    def prescreen_pairs(self, pairs: Sequence[Pair]) -> dict[Pair, StoredMatches]:
        """The pairs whose strongest features match and that matter for the place of an image, with those matches.

        A pair that is passed over may overlap nevertheless, by little: its place then follows from the others.
        """
        # These matches are few, of most pairs hardly any: a file for each would take as long as the matching.
        strongest = replace(self, features=self.features.strongest(_PRESCREEN_FEATURES), store=self.cache)
        shared = dict(zip(pairs, strongest._match(pairs, "comparing images"), strict=True))
        most = np.zeros(len(self.features), dtype=np.intp)
        for pair, matches in shared.items():
            most[[*pair]] = np.maximum(most[[*pair]], len(matches))
        promising = {
            pair: matches
            for pair, matches in shared.items()
            if len(matches) >= max(_MIN_PRESCREEN_MATCHES, _MIN_RELATIVE_MATCHES * most[[*pair]].min())
        }
        return select_pairs(promising, self.cameras)

    def estimate(
        self,
        pairs: Iterable[Pair],
        distortion: float | None = None,
        shared: Mapping[Pair, StoredMatches] | None = None,
    ) -> list[PairRegistration]:
        """Match and estimate pairs (i, j), with λ free, or as the user or the other pairs say.

        Where matches of the prescreening are given, only the parts in which the images overlap are matched.
        """
        chosen = list(pairs)
        if not chosen:
            return []
        known = self.estimation.distortion
        lens = distortion if known is None else known
        registered = self._estimate(chosen, self._match(chosen, "matching", shared or {}), lens, "registering pairs")
        return registered if known is not None or distortion is None else [_without_vote(pair) for pair in registered]

    def estimate_candidates(self, candidates: Sequence[Pair]) -> list[PairRegistration]:
        """Estimate the candidate pairs that share something at first sight; all of them where none of those holds."""
        prescreened = self.prescreen_pairs(candidates)
        pairs = self.estimate(prescreened, shared=prescreened)
        return pairs if any(pair.relation for pair in pairs) else self.estimate(candidates)

    def without_static_background(
        self, pairs: list[PairRegistration], candidates: Sequence[Pair] = ()
    ) -> "tuple[Pairing, list[PairRegistration]] | None":
        """Where a part of the images is static, the pairing and pairs of what moves; None where none is.

        What the images have in common was static then, so that it says nothing of which of the candidate pairs
        matter: all of them are compared.
        """
        threshold = self.estimation.threshold
        if not has_static_background(pairs, threshold):
            return None
        compared = [pair.images for pair in pairs]
        others = sorted(set(candidates).difference(compared))
        everything = [*pairs, *self.estimate(others)]
        chosen = sorted([*compared, *others])
        moving = replace(self, features=moving_features(self.features, everything, threshold))
        again = moving.estimate(chosen)
        return (moving, again) if show_motion(again, len(self.features), threshold) else None

    def match_repeated_patterns(self, pairs: list[PairRegistration]) -> list[PairRegistration]:
        """Where the images show a repeated pattern, match again the pairs that failed or hold by little.

        They may be off by whole periods of the pattern then; see :mod:`rdstitch.matching.repeated_pattern`.
        """
        if not self.shows_repeated_pattern:
            return pairs
        weak = [k for k, pair in enumerate(pairs) if not pair.relation or pair.relation.inliers.sum() < _FEW_INLIERS]
        chosen = [(pairs[k].image1, pairs[k].image2) for k in weak]
        matched = [StoredMatches.of(match_pattern(self.features[i], self.features[j])) for i, j in chosen]
        again = self._estimate(chosen, matched, self.estimation.distortion, "matching a repeated pattern")
        result = list(pairs)
        for k, pair in zip(weak, again, strict=True):
            inliers = pair.relation.inliers.sum()
            if pair.relation and inliers > max(_MIN_INLIER_RATIO * len(pair.matches), pairs[k].relation.inliers.sum()):
                result[k] = pair
        return result

    @cached_property
    def shows_repeated_pattern(self) -> bool:
        """Whether keypoints of most of the images look like others elsewhere in the same image."""
        if self.network is not None:
            return False
        sampled = evenly_spaced(len(self.features), _SAMPLED).tolist()
        return bool(np.median([repetition(self.features[k]) for k in sampled]) >= MIN_REPETITION)

    def rematch_elsewhere(self, pairs: Sequence[PairRegistration], transfer: Transfer) -> list[PairRegistration]:
        """Match registered pairs again, only near where ``transfer`` puts them."""
        matched = []
        for pair in pairs:
            features1, features2 = self.features[pair.image1], self.features[pair.image2]
            expected = transfer(pair.image1, pair.image2, features1.points)
            known = pair.correspondences.indices[pair.relation.inliers]
            radius = _SEARCH_RADIUS * self.estimation.threshold
            matched.append(StoredMatches.of(match_near(features1, features2, expected, radius, known, self.ratio)))
        return self._estimate([pair.images for pair in pairs], matched, self.estimation.distortion)

    def _match(
        self, pairs: Sequence[Pair], stage: str, shared: Mapping[Pair, StoredMatches] | None = None
    ) -> list[StoredMatches]:
        """Matches of every pair, from an earlier run where the cache has them."""
        # What a network finds depends on all that it is shown.
        known = {} if shared is None or self.network is not None else shared
        tasks = [(self.features.items[i], self.features.items[j], known.get((i, j))) for i, j in pairs]
        how = self.ratio, None if self.network is None else self.cache.file(self.network)
        run = partial(match_pairs, matcher=self.matcher, how=how, cache=self.store)
        done: list[StoredMatches] = []
        for matches in in_order(self.executor, run, batches(tasks, _PAIRS_MATCHED_AT_ONCE, _MIN_BATCHES)):
            done += matches
            self.progress(stage, len(done), len(pairs))
        return done

    def _estimate(
        self,
        pairs: Sequence[Pair],
        matched: Sequence[StoredMatches],
        distortion: float | None,
        stage: str | None = None,
    ) -> list[PairRegistration]:
        """The relation of every pair, from an earlier run where the cache has it."""
        solver = self.estimation.solver if distortion is None else "auto"
        options = replace(self.estimation, solver=solver, distortion=distortion)
        tilts: Sequence[Tilt | None] = self.tilts or [None] * len(self.cameras)
        tasks = [
            (self.cameras[i], self.cameras[j], matches, tilts[i], tilts[j])
            for (i, j), matches in zip(pairs, matched, strict=True)
        ]
        run = partial(estimate_pairs, options=options, cache=self.cache)
        relations: list[RadialHomography] = []
        for estimated in in_order(self.executor, run, batches(tasks, PAIRS_ESTIMATED_AT_ONCE)):
            relations += estimated
            if stage is not None:
                self.progress(stage, len(relations), len(pairs))
        every = zip(pairs, matched, relations, strict=True)
        return [PairRegistration(*images, matches, relation) for images, matches, relation in every]


def _without_vote(pair: PairRegistration) -> PairRegistration:
    """A pair whose λ was given by the others says nothing about λ."""
    return replace(pair, relation=replace(pair.relation, distortion_std=np.inf))
