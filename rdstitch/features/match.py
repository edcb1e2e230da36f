"""Matching, exactly, by distances of descriptors: everywhere, or near known places.

A match is a mutual nearest neighbour that passes the ratio test. Where the place to look is known, matches are more and
surer, above all of textures that repeat.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.features.keypoints import Correspondences, Features
from rdstitch.features.nearest import Similarity, mutual_nearest
from rdstitch.system.late_imports import spatial

Matcher = Callable[[Features, Features], Correspondences]
"""Matches the features of two images: :func:`match`, or a network's."""

_DEFAULT_RATIO = 0.85
_BLOCK_BYTES = 2**21  # two threads have room for it in the caches; the products of smaller ones take longer
_USUAL = 0.95  # fraction of the known matches' distances that a new match may not exceed


def match(
    features1: Features, features2: Features, ratio: float | None = None, block_bytes: int = _BLOCK_BYTES
) -> Correspondences:
    """Match the features of two images, which are of the same kind.

    A match is the nearest neighbour in both directions, and in both nearer than ``ratio`` times the second nearest (1
    keeps all mutual nearest neighbours); a tie is none. Where features have signs of the Laplacian, only equal signs
    match. Keypoints at one location (SIFT's several orientations) count as one. A block of distances takes
    ``block_bytes``; the result is the same for any, and for any number of threads.
    """
    limit = check_ratio(ratio)
    _check_kinds(features1, features2)
    pairs, ratios = mutual_nearest(features1, features2, block_bytes, limit)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], ratios))
    return Correspondences.of(features1, features2, pairs[order], ratios[order])


def _check_kinds(features1: Features, features2: Features) -> None:
    if features1.kind != features2.kind:
        raise ArgumentError(f"features of different kinds do not match: {features1.kind} and {features2.kind}")


def check_ratio(ratio: float | None) -> float:
    """The limit to the ratio of distances, where none is given the usual one; ArgumentError when out of range."""
    limit = _DEFAULT_RATIO if ratio is None else ratio
    if not 0 < limit <= 1:
        raise ArgumentError(f"ratio must be in (0, 1], not {limit}")
    return limit


def match_near(
    features1: Features,
    features2: Features,
    expected: FloatArray,
    radius: float,
    known: NDArray[np.intp],
    ratio: float | None = None,
) -> Correspondences:
    """Match features with those near the places where they are expected.

    As in :func:`match`, but only features within ``radius`` pixels of the ``expected`` places (N1, 2) in image 2, NaN
    where nowhere, compete; and a match is no less alike than the matches ``known`` to be right, indices (K, 2) of one
    at least.
    """
    limit = check_ratio(ratio)
    _check_kinds(features1, features2)
    candidates = _within(expected, features2.points, radius)
    if not len(candidates):
        return Correspondences.of(features1, features2, candidates, np.zeros(0))
    if not len(known):
        raise ArgumentError("to match near expected places takes one match at least that is known to be right")
    similarity = Similarity(features1.descriptors, features2.descriptors)
    sign1, sign2 = features1.laplacian_sign, features2.laplacian_sign
    if sign1 is not None and sign2 is not None:
        candidates = candidates[sign1[candidates[:, 0]] == sign2[candidates[:, 1]]]
    distance = similarity.distance(similarity.pairs(candidates[:, 0], candidates[:, 1]))
    farthest = np.quantile(similarity.distance(similarity.pairs(known[:, 0], known[:, 1])), _USUAL)
    place1, place2 = (_places(features.points)[candidates[:, k]] for k, features in enumerate((features1, features2)))
    kept = _best_of_each(np.column_stack([place1, place2]), distance)
    candidates, distance, place1, place2 = candidates[kept], distance[kept], place1[kept], place2[kept]
    worse = np.maximum(_ratios_within(place1, distance), _ratios_within(place2, distance))
    passed = np.flatnonzero((worse < limit) & (distance <= farthest))
    order = passed[np.lexsort((candidates[passed, 1], candidates[passed, 0], worse[passed]))]
    return Correspondences.of(features1, features2, candidates[order], worse[order])


def _within(expected: FloatArray, points: FloatArray, radius: float) -> NDArray[np.intp]:
    """Pairs (C, 2) of expected places and points that are not farther apart than the radius."""
    places = np.flatnonzero(np.isfinite(expected).all(axis=1))
    if not len(places) or not len(points):
        return np.zeros((0, 2), dtype=np.intp)
    near = spatial.cKDTree(expected[places]).sparse_distance_matrix(
        spatial.cKDTree(points), radius, output_type="coo_matrix"
    )
    return np.column_stack([places[near.row], near.col]).astype(np.intp)


def _places(points: FloatArray) -> NDArray[np.intp]:
    """Number the places of points, equal where they coincide: SIFT gives a point several descriptors."""
    return np.unique(points, axis=0, return_inverse=True)[1].reshape(-1)


def _best_of_each(groups: NDArray[np.intp], distance: FloatArray) -> NDArray[np.intp]:
    """Index of the nearest candidate of each group, a row of ``groups`` (C, 2) naming one."""
    order = np.lexsort((distance, groups[:, 1], groups[:, 0]))
    first = np.ones(len(order), dtype=np.bool_)
    first[1:] = (np.diff(groups[order], axis=0) != 0).any(axis=1)
    return np.sort(order[first])


def _ratios_within(group: NDArray[np.intp], distance: FloatArray) -> FloatArray:
    """Distance of each candidate (C,) over that of the nearest other one of its group; 0 where it is alone."""
    order = np.lexsort((distance, group))
    start = np.flatnonzero(np.diff(group[order], prepend=-1))
    nearest, second = np.empty(len(order)), np.full(len(order), np.inf)
    count = np.diff(start, append=len(order))
    sorted_distance = distance[order]
    nearest[order] = np.repeat(sorted_distance[start], count)
    following = np.append(sorted_distance, np.inf)[start + 1]
    second[order] = np.repeat(np.where(count > 1, following, np.inf), count)
    is_nearest = np.zeros(len(order), dtype=np.bool_)
    is_nearest[order[start]] = True
    other = np.where(is_nearest, second, nearest)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio: FloatArray = np.where(other > 0, distance / other, np.inf)
    return ratio
