"""Inliers of pairs, selected by what an alignment of all images expects."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from rdstitch.alignment import Alignment
from rdstitch.alignment.bundle_adjustment import sigma_of
from rdstitch.arrays import FloatArray
from rdstitch.cache import NO_CACHE, Cache
from rdstitch.matching.eccentricity import eccentricity
from rdstitch.matching.feature_store import StoredMatches
from rdstitch.matching.two_view import PairRegistration
from rdstitch.robust.verification import MIN_PLACES, places

_WIDTH_PER_SIGMA, _MIN_THRESHOLD = 4.0, 0.5
"""Up to how many standard deviations a match is an inlier, but at least up to so many pixels."""

_MIN_KEPT = 0.5
"""Share of its inliers that a pair must keep; otherwise the alignment does not fit it, and it stays as it is."""


def reselect_inliers(
    pairs: Sequence[PairRegistration],
    alignment: Alignment,
    threshold: float,
    radii: Sequence[FloatArray],
    store: Cache = NO_CACHE,
) -> dict[int, PairRegistration]:
    """Select the inliers of the pairs again, by what an alignment expects of their putative matches.

    Keypoints of blobs are moved to where the middle of the blob is. As blobs are no discs, that is right to about half
    of what it is, which neighbours have in common: those that it moves by more than the noise are left out, where
    there are others.

    Parameters
    ----------
    alignment : Alignment
        Of these pairs.
    threshold : float
        Distance up to which a match can be an inlier, pixels; it is less where the inliers scatter less.
    radii : sequence of ndarray of shape (N,)
        Of the features of each image, pixels; see :func:`rdstitch.matching.eccentricity.blob_radii`.
    store : Cache
        Of what need not be in memory all the time.

    Returns
    -------
    dict of int to PairRegistration
        The pairs that the alignment uses with their inliers, by their position in ``pairs``.
    """
    found = [k for k, pair in enumerate(pairs) if pair.relation]
    used = {k for k in found if (pairs[k].image1, pairs[k].image2) in alignment.support}
    moved, lengths, errors = dict[int, StoredMatches](), dict[int, FloatArray](), dict[int, FloatArray]()
    for k in found:
        i, j = pairs[k].image1, pairs[k].image2
        transfer = partial(alignment.transfer, i, j) if k in used else pairs[k].relation.transfer
        moved[k], lengths[k], errors[k] = _moved(pairs[k].matches, transfer, radii[i], store)
    known = [errors[k][pairs[k].relation.inliers] for k in used]
    sigma = sigma_of(np.concatenate([np.zeros(0), *known]) ** 2)
    farthest = min(max(_WIDTH_PER_SIGMA * sigma, _MIN_THRESHOLD), threshold)
    result = {}
    for k in found:
        relation = pairs[k].relation
        inliers = errors[k] < farthest
        if k not in used or inliers.sum() < _MIN_KEPT * relation.inliers.sum():
            inliers = relation.inliers
        sure, matches = inliers & (lengths[k] < sigma), moved[k].load()
        if places(matches.points1[sure], matches.points2[sure], relation.camera2.image_size) >= MIN_PLACES:
            inliers = sure
        result[k] = replace(pairs[k], matches=moved[k], relation=replace(relation, inliers=inliers))
    return result


def _moved(
    found: StoredMatches, transfer: Callable[[FloatArray], FloatArray], radii: FloatArray, store: Cache
) -> tuple[StoredMatches, FloatArray, FloatArray]:
    """Matches of a pair, the second keypoints moved to what the first ones show; by how much; and what is left.

    Pixels, (M,) each; inf where nothing is expected.
    """
    matches = found.load()
    shifts = eccentricity(transfer, matches.points1, radii[matches.indices[:, 0]])
    points2 = matches.points2 - np.nan_to_num(shifts)
    moved = replace(matches, points2=points2)
    stored = store.stored("moved-matches", (found.key(store), shifts), lambda: moved)
    left = transfer(matches.points1) - points2
    lengths, errors = (np.nan_to_num(np.linalg.norm(d, axis=1), nan=np.inf) for d in (shifts, left))
    return StoredMatches(stored, len(matches)), lengths, errors
