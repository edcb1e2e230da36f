"""Inliers of all pairs by one alignment with the lens that was found, where pairs on their own have λ alone."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rdstitch.alignment import Alignment
from rdstitch.alignment.bundle_adjustment import sigma_of
from rdstitch.arrays import FloatArray
from rdstitch.matching.two_view import PairRegistration

_WIDTH_PER_SIGMA, _MIN_THRESHOLD = 4.0, 0.5
"""Up to how many standard deviations a match is an inlier, but at least up to so many pixels."""

_MIN_KEPT = 0.5
"""Share of its inliers that a pair must keep; otherwise the alignment does not fit it, and it stays as it is."""


def reselect_inliers(
    pairs: Sequence[PairRegistration], alignment: Alignment, threshold: float
) -> dict[int, PairRegistration]:
    """Select the inliers of the pairs again, by what an alignment expects of their putative matches.

    Parameters
    ----------
    pairs : sequence of PairRegistration
    alignment : Alignment
        Of these pairs.
    threshold : float
        Distance up to which a match can be an inlier, pixels; it is less where the inliers scatter less.

    Returns
    -------
    dict of int to PairRegistration
        The pairs that the alignment uses with their inliers, by their position in ``pairs``.
    """
    used = [k for k, pair in enumerate(pairs) if (pair.image1, pair.image2) in alignment.support]
    errors = {k: _errors(pairs[k], alignment) for k in used}
    known = [errors[k][pairs[k].relation.inliers] for k in used]
    sigma = sigma_of(np.concatenate([np.zeros(0), *known]) ** 2)
    farthest = min(max(_WIDTH_PER_SIGMA * sigma, _MIN_THRESHOLD), threshold)
    selected = {k: replace(pairs[k].relation, inliers=errors[k] < farthest) for k in used}
    return {
        k: replace(pairs[k], relation=relation)
        for k, relation in selected.items()
        if relation.inliers.sum() >= _MIN_KEPT * pairs[k].relation.inliers.sum()
    }


def _errors(pair: PairRegistration, alignment: Alignment) -> FloatArray:
    """Distances (M,) of the putative matches of a pair from where the alignment expects them, pixels; inf for none."""
    matches = pair.correspondences
    expected = alignment.transfer(pair.image1, pair.image2, matches.points1)
    distance: FloatArray = np.nan_to_num(np.linalg.norm(expected - matches.points2, axis=1), nan=np.inf)
    return distance
