"""Matching near expected places: what repeats becomes distinct, what lies elsewhere is not looked at."""

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.features import Features, match, match_near


def _features(points: FloatArray, descriptors: FloatArray, signs: FloatArray | None = None) -> Features:
    one = np.ones(len(points))
    sign = None if signs is None else signs.astype(np.int8)
    return Features(points, descriptors.astype(np.float32), one, one, one, sign, "surf", (640, 480))


def _repeating(seed: int) -> tuple[Features, Features, FloatArray]:
    """A grid of points that look alike in groups, in two images; and the shift between these."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(20.0, 400.0, 20.0), np.arange(20.0, 300.0, 20.0)), axis=-1).reshape(-1, 2)
    looks = rng.normal(size=(5, 64))[rng.integers(0, 5, len(grid))]
    shift = np.array([33.0, 21.0])
    first, second = (looks + rng.normal(scale=0.05, size=looks.shape) for _ in range(2))
    order = rng.permutation(len(grid))
    return _features(grid, first), _features((grid + shift)[order], second[order]), shift


@pytest.mark.parametrize("seed", range(3))
def test_repeating_points_are_distinguished(seed: int) -> None:
    features1, features2, shift = _repeating(seed)
    alone = match(features1, features2)
    truth = [np.argmin(np.abs(features2.points - point - shift).sum(axis=1)) for point in features1.points]
    known = np.column_stack([np.arange(40), truth[:40]])
    near = match_near(features1, features2, features1.points + shift + 1.0, 5.0, known)
    assert len(near) > 0.8 * len(features1) > len(alone)
    assert np.allclose(near.points2 - near.points1, shift)
    assert len(np.unique(near.indices[:, 0])) == len(np.unique(near.indices[:, 1])) == len(near)


def test_only_what_is_alike_and_near_matches() -> None:
    rng = np.random.default_rng(0)
    points, looks = rng.uniform(0, 400, (50, 2)), rng.normal(size=(50, 64))
    other = rng.normal(size=(50, 64))
    features1 = _features(points, looks)
    known = np.array([[0, 0]])
    changed = _features(points, np.concatenate([looks[:10], other[10:]]))
    assert match_near(features1, changed, points, 3.0, known).indices[:, 0].tolist() == list(range(10))
    assert len(match_near(features1, features1, points + 200.0, 3.0, known)) < 5
    nowhere = np.full_like(points, np.nan)
    assert len(match_near(features1, features1, nowhere, 3.0, known)) == 0
    assert len(match_near(features1, features1.take(np.zeros(0, np.intp)), points, 3.0, known[:0])) == 0


def test_a_rival_within_the_radius_counts_one_at_the_same_place_does_not() -> None:
    points, looks = np.array([[100.0, 100.0]]), np.eye(1, 64)
    near_it = np.array([[100.0, 100.0], [102.0, 100.0]])
    here = np.array([[100.0, 100.0], [100.0, 100.0]])
    alike = np.concatenate([looks + 1e-2, looks + 1.05e-2])
    known = np.array([[0, 0]])
    assert len(match_near(_features(points, looks), _features(near_it, alike), points, 5.0, known)) == 0
    found = match_near(_features(points, looks), _features(here, alike), points, 5.0, known)
    assert found.indices.tolist() == [[0, 0]]


def test_signs_must_be_equal_and_the_ratio_in_range() -> None:
    points, looks = np.array([[10.0, 10.0]]), np.eye(1, 64)
    up, down = (_features(points, looks, np.array([sign])) for sign in (1, -1))
    known = np.array([[0, 0]])
    assert len(match_near(up, up, points, 5.0, known)) == 1
    assert len(match_near(up, down, points, 5.0, known)) == 0
    with pytest.raises(ArgumentError, match="ratio"):
        match_near(up, up, points, 5.0, known, ratio=1.5)
