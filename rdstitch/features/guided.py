"""Matching where the place to look is known: more and surer matches, above all of textures that repeat."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rdstitch.arrays import FloatArray
from rdstitch.features.keypoints import Correspondences, Features
from rdstitch.features.match import check_ratio
from rdstitch.features.nearest import compare

_USUAL = 0.95
"""Share of the known matches' distances that a new match may not exceed."""


def match_near(
    features1: Features,
    features2: Features,
    expected: FloatArray,
    radius: float,
    known: NDArray[np.intp],
    ratio: float | None = None,
) -> Correspondences:
    """Match features with those near the places where they are expected.

    As in :func:`rdstitch.features.match`, a match is the nearest in both directions and passes the ratio test in both,
    but only features within the radius compete. And it is no less alike than matches that are known to be right.

    Parameters
    ----------
    features1, features2 : Features
        Of the same kind. Where they have signs of the Laplacian, only equal signs match.
    expected : ndarray of shape (N1, 2)
        Where the features of picture 1 should be in picture 2, pixels; NaN where nowhere.
    radius : float
        How far from there is searched, pixels.
    known : ndarray of shape (K, 2), intp
        Matches that are right, as indices into features 1 and 2; at least one.
    ratio : float, optional
        As in :func:`rdstitch.features.match`.

    Raises
    ------
    ArgumentError
        When ``ratio`` is out of range.
    """
    limit = check_ratio(ratio)
    candidates = _within(expected, features2.points, radius)
    if not len(candidates):
        return Correspondences.of(features1, features2, candidates, np.zeros(0))
    similarity = compare(features1.descriptors, features2.descriptors)
    sign1, sign2 = features1.laplacian_sign, features2.laplacian_sign
    if sign1 is not None and sign2 is not None:
        candidates = candidates[sign1[candidates[:, 0]] == sign2[candidates[:, 1]]]
    distance = similarity.distance(similarity.pairs(candidates[:, 0], candidates[:, 1]))
    farthest = np.quantile(similarity.distance(similarity.pairs(known[:, 0], known[:, 1])), _USUAL)
    place1, place2 = (_places(found.points)[candidates[:, k]] for k, found in enumerate((features1, features2)))
    kept = _best_of_each(np.column_stack([place1, place2]), distance)
    candidates, distance, place1, place2 = candidates[kept], distance[kept], place1[kept], place2[kept]
    worse = np.maximum(_ratios(place1, distance), _ratios(place2, distance))
    passed = np.flatnonzero((worse < limit) & (distance <= farthest))
    order = passed[np.lexsort((candidates[passed, 1], candidates[passed, 0], worse[passed]))]
    return Correspondences.of(features1, features2, candidates[order], worse[order])


def _within(expected: FloatArray, points: FloatArray, radius: float) -> NDArray[np.intp]:
    """Pairs (C, 2) of expected places and points that are not farther apart than the radius."""
    places = np.flatnonzero(np.isfinite(expected).all(axis=1))
    if not len(places) or not len(points):
        return np.zeros((0, 2), dtype=np.intp)
    near = cKDTree(expected[places]).sparse_distance_matrix(cKDTree(points), radius, output_type="coo_matrix")
    return np.column_stack([places[near.row], near.col]).astype(np.intp)


def _places(points: FloatArray) -> NDArray[np.intp]:
    """Which points are at the same place: SIFT gives a point several descriptors."""
    number: NDArray[np.intp] = np.unique(points, axis=0, return_inverse=True)[1].reshape(-1)
    return number


def _best_of_each(groups: NDArray[np.intp], distance: FloatArray) -> NDArray[np.intp]:
    """Index of the nearest candidate of each group, a row of ``groups`` (C, 2) naming one."""
    order = np.lexsort((distance, groups[:, 1], groups[:, 0]))
    first = np.ones(len(order), dtype=np.bool_)
    first[1:] = (np.diff(groups[order], axis=0) != 0).any(axis=1)
    return np.sort(order[first])


def _ratios(group: NDArray[np.intp], distance: FloatArray) -> FloatArray:
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
