"""Prescreening: which of the candidate pairs share something, by the strongest features alone."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rdstitch.matching.candidate_pairs import select_pairs
from rdstitch.matching.feature_store import StoredMatches
from rdstitch.matching.pair_estimator import PairEstimator
from rdstitch.matching.two_view import Pair, PairRegistration

_STRONGEST = 500  # features of an image, by which pairs are prescreened
_MIN_MATCHES = 6  # matches among these; images that share nothing have two to five by chance
_MIN_RELATIVE_MATCHES = 0.05  # fraction of the matches that an image has with the one most like it; less adds nothing


def prescreen_pairs(estimator: PairEstimator, pairs: Sequence[Pair]) -> dict[Pair, StoredMatches]:
    """The pairs whose strongest features match and that matter for the place of an image, with those matches.

    A pair that is passed over may overlap nevertheless, by little: its place then follows from the others.
    """
    # These matches are few, of most pairs hardly any: a file for each would take as long as the matching.
    strongest = replace(estimator, features=estimator.features.strongest(_STRONGEST), store=estimator.cache)
    shared = dict(zip(pairs, strongest.match(pairs, "comparing images"), strict=True))
    most = np.zeros(len(estimator.features), dtype=np.intp)
    for pair, matches in shared.items():
        most[[*pair]] = np.maximum(most[[*pair]], len(matches))
    promising = {
        pair: matches
        for pair, matches in shared.items()
        if len(matches) >= max(_MIN_MATCHES, _MIN_RELATIVE_MATCHES * most[[*pair]].min())
    }
    return select_pairs(promising, estimator.cameras)


def estimate_candidates(estimator: PairEstimator, candidates: Sequence[Pair]) -> list[PairRegistration]:
    """Estimate the candidate pairs that share something at first sight; all of them where none of those holds."""
    prescreened = prescreen_pairs(estimator, candidates)
    pairs = estimator.estimate(prescreened, shared=prescreened)
    return pairs if any(pair.relation for pair in pairs) else estimator.estimate(candidates)
