"""Pairs of pictures through all rounds: matched once, estimated alone, then with what the others know."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from rdstitch.camera import Camera
from rdstitch.features import Correspondences, Features, Matcher, match_near
from rdstitch.pipeline.options import StitchOptions
from rdstitch.pipeline.progress import Progress
from rdstitch.registration import Alignment
from rdstitch.registration.pairs import PairOptions, PairRegistration, estimate_pairs, match_pairs
from rdstitch.registration.resting import most_rest, moving_features, show_motion
from rdstitch.registration.voting import vote

_FEW_MATCHES = 100  # from which on a pair needs no more
_SEARCH_RADIUS = 3.0  # thresholds around the place where a match is expected


@dataclass(frozen=True)
class Pairing:
    """What it takes to register pairs.

    Attributes
    ----------
    features : sequence of Features
    cameras : sequence of Camera
    matcher : callable
    options : StitchOptions
    progress : callable
    """

    features: Sequence[Features]
    cameras: Sequence[Camera]
    matcher: Matcher
    options: StitchOptions
    progress: Progress

    def estimate(self, pairs: Sequence[tuple[int, int]], distortion: float | None = None) -> list[PairRegistration]:
        """Match and estimate pairs (i, j), with λ free, or as the user or the other pairs say."""
        if not pairs:
            return []
        matched = match_pairs(self.features, pairs, self.matcher, partial(self.progress, "matching"))
        known = self.options.known_distortion
        found = estimate_pairs(
            self.cameras,
            pairs,
            matched,
            self._pair_options(distortion if known is None else known),
            tilts=self._tilts(),
            workers=self.options.threads,
            progress=partial(self.progress, "registering pairs"),
        )
        return found if known is not None or distortion is None else [_without_vote(pair) for pair in found]

    def look_past_rest(self, pairs: list[PairRegistration]) -> "tuple[Pairing, list[PairRegistration]]":
        """Where most pairs seem to rest, the pairing and pairs of what moves; the same again where nothing does."""
        threshold = self.options.threshold
        if not most_rest(pairs, threshold):
            return self, pairs
        moving = replace(self, features=moving_features(self.features, pairs, threshold))
        again = moving.estimate([(pair.image1, pair.image2) for pair in pairs])
        return (moving, again) if show_motion(again, len(self.features), threshold) else (self, pairs)

    def rescue(self, pairs: list[PairRegistration]) -> list[PairRegistration]:
        """Estimate the pairs that failed again, with the λ that the others agree on."""
        relations = [pair.relation for pair in pairs if pair.relation]
        failed = [index for index, pair in enumerate(pairs) if not pair.relation]
        if self.options.known_distortion is not None or not failed or not relations:
            return pairs
        consensus = vote([r.distortion for r in relations], [r.distortion_std for r in relations])
        if not np.isfinite(consensus.distortion):
            return pairs
        again = estimate_pairs(
            self.cameras,
            [(pairs[index].image1, pairs[index].image2) for index in failed],
            [pairs[index].correspondences for index in failed],
            self._pair_options(consensus.distortion),
            tilts=self._tilts(),
            workers=self.options.threads,
            progress=partial(self.progress, "retrying pairs"),
        )
        rescued = list(pairs)
        for index, pair in zip(failed, again, strict=True):
            if pair.relation:
                rescued[index] = _without_vote(pair)
        return rescued

    def strengthen(self, pairs: list[PairRegistration], alignment: Alignment) -> list[PairRegistration]:
        """Match pairs that hold together by little again, looking only where the alignment says."""
        weak = {(fit.image1, fit.image2) for fit in alignment.links if fit.used and fit.inliers < _FEW_MATCHES}
        chosen = [index for index, pair in enumerate(pairs) if pair.relation and (pair.image1, pair.image2) in weak]
        known = self.options.known_distortion
        again = estimate_pairs(
            self.cameras,
            [(pairs[index].image1, pairs[index].image2) for index in chosen],
            [self._near(pairs[index], alignment) for index in chosen],
            self._pair_options(known),
            tilts=self._tilts(),
            workers=self.options.threads,
        )
        stronger = list(pairs)
        for index, pair in zip(chosen, again, strict=True):
            if pair.relation and pair.relation.inliers.sum() > pairs[index].relation.inliers.sum():
                stronger[index] = pair
        return stronger

    def _near(self, pair: PairRegistration, alignment: Alignment) -> Correspondences:
        """Matches of a pair near the places where the alignment expects them."""
        features1, features2 = self.features[pair.image1], self.features[pair.image2]
        return match_near(
            features1,
            features2,
            alignment.transfer(pair.image1, pair.image2, features1.points),
            _SEARCH_RADIUS * self.options.threshold,
            pair.correspondences.indices[pair.relation.inliers],
            self.options.ratio,
        )

    def _pair_options(self, distortion: float | None) -> PairOptions:
        o = self.options
        solver = o.solver if distortion is None else "auto"
        return PairOptions(solver, distortion, o.threshold, o.confidence, o.max_iterations, o.seed)

    def _tilts(self) -> list[tuple[float, float] | None] | None:
        return None if self.options.tilt is None else [self.options.tilt] * len(self.cameras)


def _without_vote(pair: PairRegistration) -> PairRegistration:
    """A pair whose λ was given by the others says nothing about λ."""
    return replace(pair, relation=replace(pair.relation, distortion_std=np.inf))
