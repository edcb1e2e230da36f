"""Matching only where two images overlap, as a few matches show."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features.keypoints import Correspondences, Features
from rdstitch.features.match import Matcher
from rdstitch.system.late_imports import spatial

_MIN_MATCHES = 50  # that an overlap takes
_MAX_MATCHES = 300  # that are used
_SUPPORTING_NEIGHBOURS = 6  # other matches that a right one has near it, in both images
_NEIGHBOURHOOD = 0.2  # how near, diagonals of an image
_MAX_UNSUPPORTED = 8  # matches without them that chance explains; more may be of a part with little texture
_MIN_REACH = 0.12  # diagonals that an overlap goes on beside a match, at least
_REACH = 2.0  # times the distance to its supporting neighbours, that it goes on
_CELLS = 24  # a side, by which places are distinguished

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
    places = points1 / np.hypot(*size1), points2 / np.hypot(*size2)
    distances = np.maximum(*(spatial.distance.cdist(each, each, "sqeuclidean") for each in places))
    # Each is the first of its own neighbours.
    farthest = np.sqrt(np.partition(distances, _SUPPORTING_NEIGHBOURS, axis=1)[:, _SUPPORTING_NEIGHBOURS])
    right = farthest <= _NEIGHBOURHOOD
    if np.count_nonzero(~right) > _MAX_UNSUPPORTED:
        return None
    reach = np.maximum(_MIN_REACH, _REACH * farthest[right])
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
    middle, diagonal = (np.arange(_CELLS) + 0.5) / _CELLS, np.hypot(*size)
    across, down = (
        np.subtract.outer(middle * length / diagonal, points[:, k] / diagonal) ** 2 for k, length in enumerate(size)
    )
    covered = (down[:, None] + across < reach**2).any(axis=-1)
    column, row = np.clip(features.points / size * _CELLS, 0, _CELLS - 1).astype(np.intp).T
    return np.flatnonzero(covered[row, column])
