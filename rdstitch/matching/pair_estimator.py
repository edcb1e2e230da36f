"""Pairs of images, matched and estimated: with λ free, or as the user or other pairs know it."""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from rdstitch.executors import batches, in_order
from rdstitch.features import Matcher
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.feature_store import FeatureStore, StoredMatches
from rdstitch.matching.two_view import (
    PAIRS_ESTIMATED_AT_ONCE,
    EstimationTask,
    MatchingTask,
    Pair,
    PairRegistration,
    Tilt,
    estimate_pairs,
    match_pairs,
)
from rdstitch.robust import EstimationOptions
from rdstitch.system.cache import NO_CACHE, Cache
from rdstitch.system.progress import Progress

_PAIRS_MATCHED_AT_ONCE = 32  # pairs of a task at the most
_MIN_BATCHES = 8  # tasks at the least


@dataclass(frozen=True)
class FeatureMatching:
    """How the features of two images are matched."""

    matcher: Matcher
    ratio: float | None = None  # largest ratio of distances of a match; None: what suits the features
    network: str | Path | None = None  # ONNX file of the network that matches them instead
    name: str | None = None  # of another matcher than that by ratios or a network

    def key(self, cache: Cache) -> tuple[float | str | None, ...]:
        """Stands for it in the inputs of results."""
        return self.ratio, self.name if self.network is None else cache.file(self.network)


@dataclass(frozen=True)
class PairEstimator:
    """What it takes to match pairs of images and to estimate their two-view geometry."""

    features: FeatureStore
    cameras: Sequence[Camera]
    matching: FeatureMatching
    estimation: EstimationOptions  # its λ is that of all images, where it is known
    progress: Progress
    executor: Executor  # where batches of pairs are matched and estimated
    cache: Cache = NO_CACHE  # of results of earlier runs
    store: Cache = NO_CACHE  # of what need not be in memory all the time
    tilts: Sequence[Tilt] | None = None  # (ψ, θ), radians, of each image, where they are known exactly

    def estimate(
        self, pairs: Iterable[Pair], distortion: float | None = None, shared: Mapping[Pair, StoredMatches] | None = None
    ) -> list[PairRegistration]:
        """Match and estimate pairs (i, j), with λ free, or as the user or the other pairs say.

        Where matches of the prescreening are given, only the parts in which the images overlap are matched.
        """
        chosen = list(pairs)
        if not chosen:
            return []
        known = self.estimation.distortion
        lens = distortion if known is None else known
        matched = self.match(chosen, "matching", shared or {})
        registered = self.estimate_matched(chosen, matched, lens, "registering pairs")
        if known is not None or distortion is None:
            return registered
        # λ that the others gave says nothing about λ.
        return [replace(pair, relation=replace(pair.relation, distortion_std=np.inf)) for pair in registered]

    def match(
        self, pairs: Sequence[Pair], stage: str, shared: Mapping[Pair, StoredMatches] | None = None
    ) -> list[StoredMatches]:
        """Matches of every pair, from an earlier run where the cache has them."""
        # What a network finds depends on all that it is shown.
        known = {} if shared is None or self.matching.network is not None else shared
        items = self.features.items
        tasks = [MatchingTask(items[i], items[j], known.get((i, j))) for i, j in pairs]
        matcher, key = self.matching.matcher, self.matching.key(self.cache)
        run = partial(match_pairs, matcher=matcher, matcher_key=key, cache=self.store)
        done: list[StoredMatches] = []
        for matches in in_order(self.executor, run, batches(tasks, _PAIRS_MATCHED_AT_ONCE, _MIN_BATCHES)):
            done += matches
            self.progress(stage, len(done), len(pairs))
        return done

    def estimate_matched(
        self,
        pairs: Sequence[Pair],
        matched: Sequence[StoredMatches],
        distortion: float | None,
        stage: str | None = None,
    ) -> list[PairRegistration]:
        """The two-view geometry of every pair, from an earlier run where the cache has it."""
        solver = self.estimation.solver if distortion is None else "auto"
        options = replace(self.estimation, solver=solver, distortion=distortion)
        tilts: Sequence[Tilt | None] = self.tilts or [None] * len(self.cameras)
        tasks = [
            EstimationTask(self.cameras[i], self.cameras[j], matches, tilts[i], tilts[j])
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
