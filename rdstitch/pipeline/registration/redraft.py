"""Drafting the alignment repeatedly, with the loop closures and inliers that each draft adds."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rdstitch.alignment import Alignment
from rdstitch.matching.candidate_pairs import loop_closures
from rdstitch.matching.pair_estimator import PairEstimator
from rdstitch.matching.two_view import Pair, PairRegistration
from rdstitch.numerics.robust_loss import sigma_of
from rdstitch.pipeline.registration.aligner import AlignedPairs, Aligner, DraftedPairs

_ROUNDS = 2  # of registering more pairs and selecting inliers again at most, each by what the one before has shown
_SETTLED = 0.05  # share of the inliers that must have changed for the images to be aligned again
# Up to how many standard deviations a match is an inlier, but at least up to so many pixels.
_WIDTH_PER_SIGMA, _MIN_THRESHOLD = 4.0, 0.5
# Share of its inliers that a pair must keep; otherwise the alignment does not fit it, and it stays as it is.
_MIN_KEPT = 0.5


def draft_with_loops(
    aligner: Aligner, estimator: PairEstimator, pairs: Sequence[PairRegistration], candidates: Sequence[Pair]
) -> DraftedPairs:
    """Draft the alignment, and again with the pairs and inliers that a draft shows to be missing.

    Those are pairs of images that the poses put beside each other, candidate pairs of images without a pose, and, where
    the lens has more than λ, what it selects: with the one λ of a pair, matches at the corners of it are outliers.
    """
    aligned = aligner.draft(pairs)
    for _ in range(_ROUNDS):
        pairs, alignment = aligned.pairs, aligned.alignment
        tried, registered = {pair.images for pair in pairs}, {pair.images for pair in pairs if pair.relation}
        neighbours = loop_closures(
            alignment.cameras, alignment.homographies, registered, tried - registered, on_sphere=alignment.on_sphere
        )
        unaligned = {(i, j) for i, j in candidates if not (alignment.used[i] and alignment.used[j])} - tried
        more = estimator.estimate(sorted(unaligned.union(neighbours)), distortion=alignment.distortion)
        selected = select_by_whole_lens(aligned, aligner.threshold)
        pairs = tuple(sorted([*(selected or pairs), *more], key=lambda pair: pair.images))
        if selected is None and not any(pair.relation for pair in more):
            return replace(aligned, pairs=pairs)
        estimator.progress("aligning", 0, 1)
        known = aligned.known if selected is None and _agree(more, aligned, aligner.threshold) else None
        del aligned, alignment, selected  # what a draft was made from takes as much memory as the next one
        aligned = aligner.draft(pairs, known)
    return aligned


def _agree(pairs: Sequence[PairRegistration], aligned: AlignedPairs, threshold: float) -> bool:
    """Whether registered pairs are where a draft expects them: most matches of each are within ``threshold``, pixels.

    Then they close loops, and tell of its motion and lens no more than what it was made from.
    """
    if aligned.rough:
        return False
    for pair in (pair for pair in pairs if pair.relation):
        if not aligned.alignment.used[[*pair.images]].all():
            return False
        errors = pair.errors(aligned.alignment.transfer)[pair.relation.inliers]
        if not np.median(errors) < threshold:
            return False
    return True


def select_by_whole_lens(aligned: AlignedPairs, threshold: float) -> list[PairRegistration] | None:
    """The pairs with inliers by a lens of more than λ; None if these hardly change."""
    alignment, pairs = aligned.alignment, aligned.pairs
    if alignment.lens == "division" and not alignment.cameras[alignment.reference].higher:
        return None
    selected = reselect_inliers(pairs, alignment, threshold)
    changed = sum(int((pair.relation.inliers != pairs[k].relation.inliers).sum()) for k, pair in selected.items())
    if changed <= _SETTLED * sum(int(pair.relation.inliers.sum()) for pair in selected.values()):
        return None
    return [selected.get(k, pair) for k, pair in enumerate(pairs)]


def reselect_inliers(
    pairs: Sequence[PairRegistration], alignment: Alignment, threshold: float
) -> dict[int, PairRegistration]:
    """Select the inliers again of the pairs that an alignment uses and fits, by their position in ``pairs``.

    An inlier is within ``threshold``, pixels, of where it is expected, or less where the inliers scatter less.
    """
    errors = {k: pair.errors(alignment.transfer) for k, pair in enumerate(pairs) if pair.images in alignment.support}
    known = [errors[k][pairs[k].relation.inliers] for k in errors]
    sigma = sigma_of(np.concatenate([np.zeros(0), *known]) ** 2)
    farthest = min(max(_WIDTH_PER_SIGMA * sigma, _MIN_THRESHOLD), threshold)
    result = {}
    for k, distances in errors.items():
        relation, inliers = pairs[k].relation, distances < farthest
        if inliers.sum() >= _MIN_KEPT * relation.inliers.sum():
            result[k] = replace(pairs[k], relation=replace(relation, inliers=inliers))
    return result
