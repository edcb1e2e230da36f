"""Matching: mutual nearest neighbours that pass the ratio test, exactly, by blocked matrix products."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.features.keypoints import Correspondences, Features
from rdstitch.features.nearest import mutual_nearest

__all__ = ["Correspondences", "Matcher", "match"]

Matcher = Callable[[Features, Features], Correspondences]
"""What matches the features of two pictures: :func:`match`, or a network's."""

_DEFAULT_RATIO = 0.85
_BLOCK_BYTES = 2**21  # two threads have room for it in the caches; the products of smaller ones take longer


def match(
    features1: Features, features2: Features, ratio: float | None = None, block_bytes: int = _BLOCK_BYTES
) -> Correspondences:
    """Match the features of two pictures.

    A match is the nearest neighbour in both directions, and in both directions nearer than ``ratio`` times the
    second nearest. Exchanging the pictures exchanges the columns of the result. A tie for the nearest is no
    match. Keypoints at one location (SIFT's several orientations) count as one, and give one match at most.

    Parameters
    ----------
    features1, features2 : Features
        Of the same kind. Where they have signs of the Laplacian, only equal signs match.
    ratio : float, optional
        Limit to the ratio of distances, in (0, 1]; 1 keeps all mutual nearest neighbours.
    block_bytes : int
        Memory for one block of distances, bytes; the result is the same for any, and for any number of threads.

    Raises
    ------
    ArgumentError
        When the kinds differ, or ``ratio`` is out of range.
    """
    limit = check_ratio(ratio)
    if features1.kind != features2.kind:
        raise ArgumentError(f"features of different kinds do not match: {features1.kind} and {features2.kind}")
    pairs, ratios = _match_signs(features1, features2, block_bytes)
    passed = np.flatnonzero(ratios < limit)
    order = passed[np.lexsort((pairs[passed, 1], pairs[passed, 0], ratios[passed]))]
    return Correspondences.of(features1, features2, pairs[order], ratios[order])


def check_ratio(ratio: float | None) -> float:
    """The limit to the ratio of distances, where none is given the usual one; ArgumentError when out of range."""
    limit = _DEFAULT_RATIO if ratio is None else ratio
    if not 0 < limit <= 1:
        raise ArgumentError(f"ratio must be in (0, 1], not {limit}")
    return limit


def _match_signs(features1: Features, features2: Features, block_bytes: int) -> tuple[NDArray[np.intp], FloatArray]:
    """Mutual nearest neighbours, within each sign of the Laplacian if the features have one."""
    sign1, sign2 = features1.laplacian_sign, features2.laplacian_sign
    if sign1 is None or sign2 is None:
        return mutual_nearest(features1, features2, block_bytes)
    pairs, ratios = [], []
    for sign in (-1, 1):
        index1, index2 = np.flatnonzero(sign1 == sign), np.flatnonzero(sign2 == sign)
        found, ratio = mutual_nearest(features1.take(index1), features2.take(index2), block_bytes)
        pairs.append(np.column_stack([index1[found[:, 0]], index2[found[:, 1]]]))
        ratios.append(ratio)
    return np.concatenate(pairs), np.concatenate(ratios)
