"""Inliers of pairs, selected by what an alignment of all images expects."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rdstitch.alignment import Alignment
from rdstitch.alignment.bundle_adjustment import sigma_of
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
    alignment : Alignment
        Of these pairs.
    threshold : float
        Distance up to which a match can be an inlier, pixels; it is less where the inliers scatter less.

    Returns
    -------
    dict of int to PairRegistration
        The pairs that the alignment uses and fits, with their inliers, by their position in ``pairs``.
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
