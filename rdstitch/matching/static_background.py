"""What is static in the images while the plane moves: a robot's own body, a background, dirt on the lens, a date.

Matches between such things agree that nothing moved. Where they outnumber the matches of the plane, a pair looks as if
the camera stood still; images far apart, which share nothing else, always do. Without them, the pairs show how the
plane moved.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.features import Correspondences
from rdstitch.matching.feature_store import FeatureStore, Size
from rdstitch.matching.match_graph import connected_components
from rdstitch.matching.pair_estimator import PairEstimator
from rdstitch.matching.two_view import Pair, PairRegistration
from rdstitch.system.late_imports import spatial

_MIN_IMAGES = 3  # images that pairs which move must connect: two could agree by chance
_MIN_CONNECTED = 0.5  # the same as a fraction of all images
_MAX_STATIC_MOTION = 1.0 / 3.0
"""Motion of a static match at most, in thresholds: its two keypoints are localised to better than that."""

_MIN_CONNECTED_MATCHES = 8
"""Of a pair that moves. Wrong matches lie anywhere: of 1,000, less than one ends within a pixel of where it began."""

_MIN_CONFIRMATIONS = 3  # static matches at one place, from which on every feature there counts as static

_MIN_OVERLAID_PAIRS = 2  # pairs with such matches: by one alone nothing is decided
_MIN_OVERLAID_FRACTION = 0.2  # the same as a fraction of the pairs that move


@dataclass(frozen=True, eq=False)
class _Motion:
    """How the matches of a pair moved, which is read once."""

    matches: Correspondences
    moved: FloatArray  # (M,): how far each match moved in the image, pixels
    static: bool  # whether the pair is registered as if nothing had moved
    overlay: BoolArray  # (M,): static matches of a pair that moves; none where they are no more than chance brings

    @classmethod
    def of(cls, pair: PairRegistration, threshold: float) -> Self:
        """``threshold`` is that of the pair's inliers, pixels."""
        matches, inliers, radius = pair.correspondences, pair.relation.inliers, threshold * _MAX_STATIC_MOTION
        moved = np.linalg.norm(matches.points2 - matches.points1, axis=1)
        static = bool(pair.relation) and float(np.median(moved[inliers])) < radius
        overlay = (moved < radius) & ~inliers
        overlaid = bool(pair.relation) and not static and int(overlay.sum()) >= _MIN_CONNECTED_MATCHES
        return cls(matches, moved, static, overlay & overlaid)


def without_static_background(
    estimator: PairEstimator, pairs: list[PairRegistration], candidates: Sequence[Pair] = ()
) -> tuple[PairEstimator, list[PairRegistration]] | None:
    """Where a part of the images is static, the estimator and pairs of what moves; None where none is.

    All candidate pairs are compared: what the images have in common was static, and did not show which of them matter.
    """
    threshold = estimator.estimation.threshold
    if not has_static_background(pairs, threshold):
        return None
    compared = [pair.images for pair in pairs]
    others = sorted(set(candidates).difference(compared))
    all_pairs = [*pairs, *estimator.estimate(others)]
    moving = replace(estimator, features=moving_features(estimator.features, all_pairs, threshold))
    pairs_of_moving = moving.estimate(sorted([*compared, *others]))
    shown = show_motion(pairs_of_moving, len(estimator.features), threshold)
    return (moving, pairs_of_moving) if shown else None


def is_static_pair(pair: PairRegistration, threshold: float) -> bool:
    """Whether a pair is registered as if nothing had moved; ``threshold`` is that of its inliers, pixels."""
    return bool(pair.relation) and _Motion.of(pair, threshold).static


def has_static_background(pairs: Sequence[PairRegistration], threshold: float) -> bool:
    """Whether most of the registered pairs are static, or several that move have static matches besides."""
    registered = static = overlaid = 0
    for motion in (_Motion.of(pair, threshold) for pair in pairs if pair.relation):
        registered += 1
        static += motion.static
        overlaid += bool(motion.overlay.any())
    enough = max(_MIN_OVERLAID_PAIRS, _MIN_OVERLAID_FRACTION * (registered - static))
    return 2 * static > registered or overlaid >= enough


def moving_features(features: FeatureStore, pairs: Sequence[PairRegistration], threshold: float) -> FeatureStore:
    """The features of each image without those that have a static match, or lie where several pairs have one.

    The latter were matched otherwise at first; once the others are gone, they would find what is static, too.
    """
    moving = [np.ones(count, dtype=np.bool_) for count in features.counts]
    # By the size of the images: pixels of others are elsewhere.
    places = defaultdict[Size | None, list[FloatArray]](list)
    for pair in pairs:
        motion = _Motion.of(pair, threshold)
        # Of a static pair all that move little, of others those of an overlay.
        static_matches = motion.moved < threshold if motion.static else motion.overlay
        matched = motion.matches.take(np.flatnonzero(static_matches))
        moving[pair.image1][matched.indices[:, 0]] = False
        moving[pair.image2][matched.indices[:, 1]] = False
        size1, size2 = pair.relation.camera.image_size, pair.relation.camera2.image_size
        places[size1].append(matched.points1)
        if size2 != size1:
            places[size2].append(matched.points2)
    radius = threshold * _MAX_STATIC_MOTION
    static = dict[Size | None, "spatial.cKDTree"]()  # places that lie within the radius of several
    for size, of_size in places.items():
        tree = spatial.cKDTree(together := np.concatenate(of_size))
        confirmations = tree.query_ball_point(together, radius, return_length=True)
        static[size] = spatial.cKDTree(together[confirmations >= _MIN_CONFIRMATIONS])
    for loaded, kept in zip(features, moving, strict=True):
        if loaded.image_size in static:
            kept &= ~np.isfinite(static[loaded.image_size].query(loaded.points, distance_upper_bound=radius)[0])
    return FeatureStore(
        tuple(stored.take(np.flatnonzero(kept)) for stored, kept in zip(features.items, moving, strict=True))
    )


def show_motion(pairs: Sequence[PairRegistration], count: int, threshold: float) -> bool:
    """Whether pairs that do move connect a good part of the ``count`` images, so that this is no chance."""
    linked = [pair for pair in pairs if pair.relation and not is_static_pair(pair, threshold)]
    connected = connected_components(count, [pair.image1 for pair in linked], [pair.image2 for pair in linked])[0]
    return len(connected) >= max(_MIN_IMAGES, _MIN_CONNECTED * count)
