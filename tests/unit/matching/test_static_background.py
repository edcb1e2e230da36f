"""What stays where it is in the image, and by how little it may move to count as that."""

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.features import Correspondences, Features
from rdstitch.matching.feature_store import FeatureStore, StoredMatches
from rdstitch.matching.static_background import has_static_background, is_static_pair, moving_features, show_motion
from rdstitch.matching.two_view import PairRegistration
from rdstitch.radial_homography import RadialHomography

THRESHOLD = 3.0
LENS = Camera((640, 480))


def _pair(moved: FloatArray, image1: int = 0, image2: int = 1) -> PairRegistration:
    """A registered pair whose matches all agree, each moved to the right by so many pixels."""
    count = len(moved)
    points = np.random.default_rng(0).uniform((0.0, 0.0), (600.0, 479.0), (count, 2))
    indices = np.stack([np.arange(count), np.arange(count)[::-1]], axis=1)
    matched = Correspondences(indices, points, points + np.stack([moved, np.zeros(count)], axis=1), np.ones(count))
    relation = RadialHomography(np.eye(3), LENS, LENS, np.ones(count, np.bool_))
    return PairRegistration(image1, image2, StoredMatches.of(matched), relation)


def _failed(image1: int, image2: int) -> PairRegistration:
    pair = _pair(np.zeros(10), image1, image2)
    return PairRegistration(image1, image2, pair.matches, RadialHomography.failed("no", LENS, LENS, 10))


@pytest.mark.parametrize(("moved", "static"), [(0.0, True), (0.9, True), (1.1, False), (2.0, False), (40.0, False)])
def test_a_pair_is_static_where_most_inliers_move_by_less_than_a_third_of_the_threshold(
    moved: float, static: bool
) -> None:
    assert is_static_pair(_pair(np.full(40, moved)), THRESHOLD) is static
    # Most decide, not the mean and not all.
    assert is_static_pair(_pair(np.append(np.full(31, moved), np.full(9, 90.0))), THRESHOLD) is static


def test_only_inliers_decide_and_no_failed_pair_is_static() -> None:
    pair = _pair(np.append(np.full(10, 20.0), np.zeros(30)))
    pair.relation.inliers[10:] = False
    assert not is_static_pair(pair, THRESHOLD)
    assert not is_static_pair(_failed(0, 1), THRESHOLD)


def test_what_moves_by_less_than_the_threshold_is_taken_out_of_static_pairs_only() -> None:
    count = 40
    one = np.ones(count)
    numbers = np.arange(count, dtype=np.float64)
    features = [
        Features(np.zeros((count, 2)), np.zeros((count, 8), np.float32), numbers, one, one, None, "made up")
    ] * 3
    # Of the static pair, ten matches move by more than the threshold.
    moved = np.append(np.zeros(28), [2.9, 2.9, *[3.1] * 5, *[50.0] * 5])
    pairs = [_pair(moved), _pair(np.full(count, 30.0), 1, 2), _failed(0, 2)]
    left = [found.scale.tolist() for found in moving_features(FeatureStore.of(features), pairs, THRESHOLD)]
    assert left == [list(range(30, 40)), list(range(10)), list(range(40))]


def test_most_pairs_are_static_by_their_majority() -> None:
    rest, move = _pair(np.zeros(40)), _pair(np.full(40, 30.0))
    assert has_static_background([rest, rest, move], THRESHOLD)
    assert not has_static_background([rest, move], THRESHOLD)
    assert not has_static_background([rest, move, _failed(0, 1)], THRESHOLD)


@pytest.mark.parametrize(
    ("links", "count", "shown"),
    [
        ([(0, 1), (1, 2)], 3, True),
        ([(0, 1)], 2, False),  # two images may do so by chance
        ([(0, 1), (1, 2)], 6, True),
        ([(0, 1), (1, 2)], 7, False),  # less than half
        ([(0, 1), (2, 3), (4, 5)], 6, False),  # not connected
    ],
)
def test_motion_is_shown_by_a_connected_good_part(links: list[tuple[int, int]], count: int, shown: bool) -> None:
    pairs = [_pair(np.full(40, 30.0), *link) for link in links]
    pairs += [_pair(np.zeros(40), 0, other) for other in range(1, count)]
    assert show_motion(pairs, count, THRESHOLD) is shown


def _overlaid(static: int, image1: int = 0, image2: int = 1) -> PairRegistration:
    """A pair that moves, with some static matches that are no inliers."""
    pair = _pair(np.append(np.full(40, 30.0), np.zeros(static)), image1, image2)
    pair.relation.inliers[40:] = False
    return pair


def test_static_matches_besides_motion_are_a_background_where_several_pairs_have_them() -> None:
    move = _pair(np.full(40, 30.0))
    assert has_static_background([_overlaid(8), _overlaid(8), move], THRESHOLD)
    assert not has_static_background([_overlaid(7), _overlaid(7), move], THRESHOLD)
    assert not has_static_background([_overlaid(8), move, move], THRESHOLD)
    assert not has_static_background([_overlaid(8), _overlaid(8), *[move] * 9], THRESHOLD)


def _with_overlay(static: int, image1: int = 0, image2: int = 1, *, seed: int = 0) -> PairRegistration:
    """A pair that moves by 30 pixels, with so many static outliers at the same places of every such pair."""
    pair = _pair(np.append(np.full(40, 30.0), np.full(static, 0.2)), image1, image2)
    pair.relation.inliers[40:] = False
    pair.correspondences.points1[:40] += np.random.default_rng(seed).uniform(0.0, 100.0, (40, 2))
    return pair


def test_of_a_pair_that_moves_only_static_outliers_are_taken_out() -> None:
    one, numbers = np.ones(48), np.arange(48.0)
    features = [Features(np.zeros((48, 2)), np.zeros((48, 8), np.float32), numbers, one, one, None, "made up")] * 2
    first, second = moving_features(FeatureStore.of(features), [_with_overlay(8)], THRESHOLD)
    assert first.scale.tolist() == list(range(40))
    assert second.scale.tolist() == list(range(8, 48))


@pytest.mark.parametrize(("pairs", "left"), [(3, 40), (2, 48)])
def test_a_place_is_static_from_three_static_matches_on(pairs: int, left: int) -> None:
    """Of an image of which no pair was estimated."""
    seen = [_with_overlay(8, 0, 1 + k, seed=k) for k in range(pairs)]
    one, points = np.ones(48), seen[0].correspondences.points1.copy()
    points[40:] += (0.6, 0.7)  # nearer than a static match moves
    features = [Features(points, np.zeros((48, 8), np.float32), one, one, one, None, "made up")] * 6
    assert len(moving_features(FeatureStore.of(features), seen, THRESHOLD)[5]) == left
