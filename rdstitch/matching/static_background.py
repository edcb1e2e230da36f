"""What rests in the picture while the plane moves: the background of a board carried about, dirt on the lens, a date.

Matches between such things agree that nothing moved. Where they outnumber the matches of the plane, every pair looks
as if the camera stood still; without them, the pairs show how the plane moved.
"""

from collections.abc import Sequence

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.features import Features
from rdstitch.matching.match_graph import connected_components
from rdstitch.matching.two_view import PairRegistration

_LEAST_PICTURES = 3
_LEAST_SHARE = 0.5


def is_static_pair(pair: PairRegistration, threshold: float) -> bool:
    """Whether a pair is registered as if nothing had moved; ``threshold`` is that of its inliers, px."""
    return bool(pair.relation) and float(np.median(_moved(pair)[pair.relation.inliers])) < threshold / 3


def most_rest(pairs: Sequence[PairRegistration], threshold: float) -> bool:
    """Whether in most of the registered pairs nothing seems to have moved."""
    registered = [pair for pair in pairs if pair.relation]
    return 2 * sum(is_static_pair(pair, threshold) for pair in registered) > len(registered)


def moving_features(
    features: Sequence[Features], pairs: Sequence[PairRegistration], threshold: float
) -> list[Features]:
    """The features of each picture without those that rest, between any two pictures that do."""
    moving = [np.ones(len(found), dtype=np.bool_) for found in features]
    for pair in pairs:
        if is_static_pair(pair, threshold):
            resting = pair.correspondences.indices[_moved(pair) < threshold]
            moving[pair.image1][resting[:, 0]] = False
            moving[pair.image2][resting[:, 1]] = False
    return [found.take(np.flatnonzero(kept)) for found, kept in zip(features, moving, strict=True)]


def show_motion(pairs: Sequence[PairRegistration], count: int, threshold: float) -> bool:
    """Whether pairs that do move connect a good part of the ``count`` pictures, so that this is no chance."""
    linked = [pair for pair in pairs if pair.relation and not is_static_pair(pair, threshold)]
    largest = connected_components(count, [pair.image1 for pair in linked], [pair.image2 for pair in linked])[0]
    return len(largest) >= max(_LEAST_PICTURES, _LEAST_SHARE * count)


def _moved(pair: PairRegistration) -> FloatArray:
    """How far each match moved in the picture, px."""
    moved: FloatArray = np.linalg.norm(pair.correspondences.points2 - pair.correspondences.points1, axis=1)
    return moved
