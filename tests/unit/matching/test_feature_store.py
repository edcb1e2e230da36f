"""Features and matches by name: the pixels they are wanted in, and those that are chosen."""

from pathlib import Path

import numpy as np

from rdstitch.cache import Cache
from rdstitch.features import Correspondences, Features
from rdstitch.matching.feature_store import FeatureStore, StoredMatches


def _features(count: int, size: tuple[int, int]) -> Features:
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.5, -0.5), np.array(size) - 0.5, (count, 2))
    numbers = np.arange(float(count))
    descriptors = rng.integers(0, 9, (count, 8)).astype(np.float32)
    return Features(points, descriptors, numbers, numbers, -numbers, None, "x", size)


def test_features_are_read_in_the_pixels_that_are_wanted() -> None:
    features = _features(30, (801, 600))
    (smaller,) = FeatureStore.of([features]).at_sizes([(401, 300)])
    assert smaller.image_size == (401, 300)
    # The corners of the images stay where they are, and so do half diagonals.
    ratio = np.hypot(401, 300) / np.hypot(801, 600)
    np.testing.assert_allclose(smaller.points, (features.points - (400, 299.5)) * ratio + (200, 149.5), atol=0.4)
    np.testing.assert_allclose(smaller.scale, features.scale * ratio, rtol=2e-3)
    np.testing.assert_array_equal(smaller.descriptors, features.descriptors)


def test_chosen_features_keep_their_order_and_the_strongest_come_first() -> None:
    store = FeatureStore.of([_features(30, (640, 480))])
    chosen = FeatureStore((store.items[0].take(np.array([7, 3, 20])),))
    assert chosen[0].scale.tolist() == [7, 3, 20]
    assert FeatureStore((chosen.items[0].take(np.array([2, 0])),))[0].scale.tolist() == [20, 7]
    assert chosen.strongest(2)[0].scale.tolist() == [7, 3]
    assert chosen.strongest(2).counts.tolist() == [2]
    assert chosen.strongest(5).counts.tolist() == [3]
    assert store.strongest(4)[0].scale.tolist() == [0, 1, 2, 3]


def test_what_is_chosen_is_part_of_the_key(tmp_path: Path) -> None:
    item, cache = FeatureStore.of([_features(30, (640, 480))]).items[0], Cache(tmp_path)
    others = [item.take(np.arange(5)), item.take(np.arange(6))]
    assert len({entry.key(cache) for entry in (item, *others)}) == 3
    assert item.key(cache) == FeatureStore.of([_features(30, (640, 480))]).items[0].key(cache)


def test_matches_are_read_in_the_pixels_that_are_wanted() -> None:
    points = np.array([[0.0, 0.0], [639.0, 479.0]])
    indices = np.zeros((2, 2), np.intp)
    matches = StoredMatches.of(Correspondences(indices, points, points[::-1].copy(), np.ones(2)))
    assert len(matches) == 2
    larger = matches.resized(((640, 480), (640, 480)), ((1280, 960), (640, 480))).load()
    np.testing.assert_allclose(larger.points1, [[0.5, 0.5], [1278.5, 958.5]], atol=0.01)
    np.testing.assert_array_equal(larger.points2, points[::-1])
