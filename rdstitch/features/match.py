"""Matching, exactly, by distances of descriptors: everywhere, where two images overlap, or near known places.

A match is a mutual nearest neighbour that passes the ratio test. Where the place to look is known, matches are more and
surer, above all of textures that repeat.
"""

from collections.abc import Callable
from dataclasses import replace

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
_USUAL = 0.95  # share of the known matches' distances that a new match may not exceed
_MIN_MATCHES, _MAX_MATCHES = 50, 300  # matches that an overlap takes at least, and that are used at most
_SUPPORTING_NEIGHBOURS = 6  # other matches that a right one has near it, in both images
_NEIGHBOURHOOD = 0.2  # how near, diagonals of an image
_STRAY = 8  # matches without such company that chance explains; more may be of a part with little texture
_MIN_REACH, _REACH = 0.12, 2.0  # how far an overlap goes on beside a match: diagonals, times the way to its company
_CELLS = 24  # a side, by which places are distinguished


def match(
    features1: Features, features2: Features, ratio: float | None = None, block_bytes: int = _BLOCK_BYTES
) -> Correspondences:
    """Match the features of two images, which are of the same kind.

    A match is the nearest neighbour in both directions, and in both directions nearer than ``ratio`` times the second
    nearest (1 keeps all mutual nearest neighbours). Exchanging the images exchanges the columns of the result. A tie
    for the nearest is no match. Where features have signs of the Laplacian, only equal signs match. Keypoints at one
    location (SIFT's several orientations) count as one, and give one match at most. One block of distances takes
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
    number: NDArray[np.intp] = np.unique(points, axis=0, return_inverse=True)[1].reshape(-1)
    return number


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


Part = NDArray[np.intp]
"""Indices of the features in one part of an image, ascending."""


def overlapping(features1: Features, features2: Features, matches: Correspondences) -> tuple[Part, Part] | None:
    """Indices of the features of two images that lie where these overlap, generously.

    An overlap is what lies around the matches, the most distinctive first, twice as far as these are apart there: where
    texture is poor and matches are few, it goes on for longer. None where they are too few or too scattered.
    """
    size1, size2 = features1.image_size, features2.image_size
    if len(matches) < _MIN_MATCHES or size1 is None or size2 is None:
        return None
    points1, points2 = matches.points1[:_MAX_MATCHES], matches.points2[:_MAX_MATCHES]
    apart = np.maximum(_distances(points1, points1, size1), _distances(points2, points2, size2))
    # Each is the first in its own company.
    company = np.partition(apart, _SUPPORTING_NEIGHBOURS, axis=1)[:, _SUPPORTING_NEIGHBOURS]
    right = company <= _NEIGHBOURHOOD
    if np.count_nonzero(~right) > _STRAY:
        return None
    reach = np.maximum(_MIN_REACH, _REACH * company[right])
    return _around(features1, size1, points1[right], reach), _around(features2, size2, points2[right], reach)


def match_overlap(
    matcher: Matcher, features1: Features, features2: Features, matches: Correspondences
) -> Correspondences:
    """Match the features of two images where a few ``matches`` show an overlap; everywhere if they do not."""
    parts = overlapping(features1, features2, matches)
    if parts is None:
        return matcher(features1, features2)
    matched = matcher(features1.take(parts[0]), features2.take(parts[1]))
    indices = np.column_stack([part[matched.indices[:, k]] for k, part in enumerate(parts)])
    return replace(matched, indices=indices)


def _around(features: Features, size: tuple[int, int], points: FloatArray, reach: FloatArray) -> Part:
    """The features in the cells of an image whose centre is within reach of one of the points."""
    middle = (np.arange(_CELLS) + 0.5) / _CELLS
    centres = np.stack(np.meshgrid(middle * size[0], middle * size[1]), axis=-1).reshape(-1, 2)
    covered = np.any(_distances(centres, points, size) < reach, axis=1)
    column, row = np.clip(features.points / size * _CELLS, 0, _CELLS - 1).astype(np.intp).T
    return np.flatnonzero(covered[row * _CELLS + column])


def _distances(points: FloatArray, others: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Between all points (N, 2) and all others (M, 2), diagonals of the image, (N, M)."""
    points, others = (each / np.hypot(*size) for each in (points, others))
    across, down = (np.subtract.outer(points[:, k], others[:, k]) for k in (0, 1))
    return np.asarray(np.sqrt(across**2 + down**2), dtype=np.float64)
