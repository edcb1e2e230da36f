"""Matching descriptors: all of them, those a guess leaves, and those of an overlap."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.features import Correspondences, Features, match, match_near, match_overlap
from rdstitch.features.overlap import overlapping

SIZE = (800, 600)


def features(
    descriptors: NDArray[Any],
    points: NDArray[np.float64] | None = None,
    kind: str = "sift",
    signs: FloatArray | None = None,
) -> Features:
    """Features with given descriptors, by default each at a place of its own."""
    count = len(descriptors)
    if points is None:
        points = np.column_stack([np.arange(count), np.zeros(count)]).astype(np.float64)
    descriptors = descriptors if kind == "akaze" else descriptors.astype(np.float32)
    zeros, sign = np.zeros(count), None if signs is None else signs.astype(np.int8)
    return Features(points, descriptors, zeros + 1, zeros, zeros, sign, kind, SIZE)


def sift_like(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Integers of norm about 512 in 128 dimensions."""
    values = rng.gamma(0.6, size=(count, 128))
    unit: NDArray[np.float64] = values / np.linalg.norm(values, axis=1, keepdims=True)
    return np.rint(512 * unit).astype(np.float32)


def pair_of(kind: str, seed: int) -> tuple[Features, Features]:
    """Two images of which half the features show the same."""
    rng = np.random.default_rng(seed)
    if kind == "binary":
        bits = rng.integers(0, 256, (150, 61), dtype=np.uint8)
        noise = rng.integers(0, 256, bits.shape) * (rng.random(bits.shape) < 0.15)
        other = np.where(np.arange(150)[:, None] < 75, bits ^ noise.astype(np.uint8), rng.permuted(bits, axis=1))
        return features(bits, kind="akaze"), features(other[rng.permutation(150)][:140], kind="akaze")
    values = sift_like(rng, 150)
    other = sift_like(rng, 150)
    other[:75] = np.rint(values[:75] * rng.uniform(0.7, 1.3, (75, 128)))
    other = other[rng.permutation(150)][:140]
    if kind == "signed":
        values, other = values / np.float32(512), other / np.float32(512)
        signs = [np.where(rng.random(n) < 0.5, 1.0, -1.0) for n in (150, 140)]
        return features(values, kind="surf", signs=signs[0]), features(other, kind="surf", signs=signs[1])
    return features(values), features(other)


def distances(one: Features, two: Features) -> NDArray[np.float64]:
    if one.binary:
        bits = [np.unpackbits(np.asarray(f.descriptors, np.uint8), axis=1).astype(np.int64) for f in (one, two)]
        return np.asarray(np.abs(bits[0][:, None] - bits[1]).sum(axis=2), np.float64)
    difference = one.descriptors.astype(np.float64)[:, None] - two.descriptors.astype(np.float64)
    table: NDArray[np.float64] = np.linalg.norm(difference, axis=2)
    if one.laplacian_sign is not None and two.laplacian_sign is not None:
        table[one.laplacian_sign[:, None] != two.laplacian_sign] = np.inf
    return table


def by_definition(one: Features, two: Features, ratio: float) -> set[tuple[int, int]]:
    """Mutual nearest neighbours that pass the ratio test in both directions."""
    table = distances(one, two)
    found = set()
    for i, row in enumerate(table):
        j = int(row.argmin())
        column = table[:, j]
        rivals = min(np.delete(row, j).min(), np.delete(column, i).min())
        if column.argmin() == i and row[j] < ratio * rivals:
            found.add((i, j))
    return found


def as_set(indices: NDArray[np.intp]) -> set[tuple[int, int]]:
    return {(int(i), int(j)) for i, j in indices}


@pytest.mark.parametrize("kind", ["float", "binary", "signed"])
@pytest.mark.parametrize("ratio", [0.6, 0.8, 1.0])
@pytest.mark.parametrize("block_bytes", [1, 5000, 2**23])
def test_matches_are_those_of_the_definition(kind: str, ratio: float, block_bytes: int) -> None:
    one, two = pair_of(kind, seed=3)
    found = match(one, two, ratio, block_bytes)
    assert len(found) > 15
    assert as_set(found.indices) == by_definition(one, two, ratio)


@pytest.mark.parametrize("kind", ["float", "binary", "signed"])
def test_blocks_and_exchange_change_nothing(kind: str) -> None:
    one, two = pair_of(kind, seed=4)
    reference = match(one, two, 0.9)
    small, exchanged = match(one, two, 0.9, block_bytes=3000), match(two, one, 0.9)
    np.testing.assert_array_equal(small.indices, reference.indices)
    np.testing.assert_array_equal(small.ratio, reference.ratio)
    assert as_set(exchanged.indices[:, ::-1]) == as_set(reference.indices)
    np.testing.assert_array_equal(exchanged.ratio, reference.ratio)


@pytest.mark.parametrize("kind", ["float", "binary"])
def test_the_ratio_is_that_of_the_distances_and_orders_the_matches(kind: str) -> None:
    one, two = pair_of(kind, seed=5)
    found, table = match(one, two, 0.95), distances(one, two)
    assert (np.diff(found.ratio) >= 0).all()
    for (i, j), ratio in zip(found.indices, found.ratio, strict=True):
        rivals = min(np.delete(table[i], j).min(), np.delete(table[:, j], i).min())
        assert ratio == pytest.approx(table[i, j] / rivals, rel=1e-12)
    np.testing.assert_array_equal(found.points1, one.points[found.indices[:, 0]])
    np.testing.assert_array_equal(found.points2, two.points[found.indices[:, 1]])


def test_a_tie_is_no_match() -> None:
    rng = np.random.default_rng(7)
    values = sift_like(rng, 20)
    twice = np.vstack([values, values[:5]])
    for one, two in ((values, twice), (twice, values)):
        found = as_set(match(features(one), features(two), 1.0).indices)
        assert found == {(i, i) for i in range(5, 20)}


def test_orientations_of_one_point_do_not_compete_and_give_one_match() -> None:
    rng = np.random.default_rng(8)
    values = sift_like(rng, 30)
    # Ten points have a second descriptor, nearly that of the first: alone, neither would pass the ratio test.
    similar = values[:10] + rng.integers(-1, 2, (10, 128)).astype(np.float32)
    points = rng.uniform(0, 100, (30, 2))
    order = rng.permutation(40)
    one = features(np.vstack([values, similar])[order], np.vstack([points, points[:10]])[order])
    two = features(values + rng.integers(-2, 3, values.shape).astype(np.float32), points)
    for a, b in ((one, two), (two, one), (one, one)):
        found = match(a, b, 0.8)
        assert len(found) == 30
        np.testing.assert_array_equal(found.points1, found.points2)
    apart = features(one.descriptors)
    assert len(match(apart, two, 0.8)) == 20


def test_of_several_orientations_the_most_alike_pair_is_named() -> None:
    rng = np.random.default_rng(9)
    values = sift_like(rng, 12)
    points = np.repeat(rng.uniform(0, 100, (4, 2)), 3, axis=0)
    exact = [2, 4, 6, 9]  # one descriptor of each point is unchanged
    other = sift_like(rng, 12)
    other[exact] = values[exact]
    found = match(features(values, points), features(other, points), 0.99)
    assert as_set(found.indices) == {(i, i) for i in exact}


@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
def test_nothing_matches_nothing(dtype: type) -> None:
    none, some = features(np.zeros((0, 32), dtype)), features(np.ones((1, 32), dtype))
    for one, two in ((none, some), (some, none), (none, none)):
        found = match(one, two)
        assert (found.indices.shape, found.points1.shape, found.ratio.shape) == ((0, 2), (0, 2), (0,))
    assert as_set(match(some, some).indices) == {(0, 0)}


def test_bad_arguments_are_refused() -> None:
    one, two = pair_of("float", seed=1)
    with pytest.raises(ArgumentError, match="ratio"):
        match(one, two, 0.0)
    with pytest.raises(ArgumentError, match="ratio"):
        match_near(one, two, one.points, 5.0, np.array([[0, 0]]), ratio=1.5)
    with pytest.raises(ArgumentError, match="kinds"):
        match(one, replace(two, kind="rootsift"))
    with pytest.raises(ArgumentError, match="descriptors of shape"):
        replace(one, descriptors=one.descriptors[1:])
    with pytest.raises(ArgumentError, match="finite"):
        replace(one, points=one.points * np.nan)


def _repeating(seed: int) -> tuple[Features, Features, FloatArray]:
    """A grid of points that look alike in groups, in two images; and the shift between these."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(20.0, 400.0, 20.0), np.arange(20.0, 300.0, 20.0)), axis=-1).reshape(-1, 2)
    looks = rng.normal(size=(5, 64))[rng.integers(0, 5, len(grid))]
    shift = np.array([33.0, 21.0])
    first, second = (looks + rng.normal(scale=0.05, size=looks.shape) for _ in range(2))
    order = rng.permutation(len(grid))
    return features(first, grid), features(second[order], (grid + shift)[order]), shift


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
    features1 = features(looks, points)
    known = np.array([[0, 0]])
    changed = features(np.concatenate([looks[:10], other[10:]]), points)
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
    assert len(match_near(features(looks, points), features(alike, near_it), points, 5.0, known)) == 0
    found = match_near(features(looks, points), features(alike, here), points, 5.0, known)
    assert found.indices.tolist() == [[0, 0]]
    # Signs must be equal.
    up, down = (features(looks, points, "surf", np.array([sign])) for sign in (1, -1))
    assert [len(match_near(up, other, points, 5.0, known)) for other in (up, down)] == [1, 0]
    with pytest.raises(ArgumentError, match="different kinds"):
        match_near(up, features(looks, points, "sift"), points, 5.0, known)
    with pytest.raises(ArgumentError, match="one match at least"):
        match_near(up, up, points, 5.0, known[:0])


SHIFT = np.array([560.0, 0.0])  # three tenths of the first image are in the second


@pytest.fixture(scope="module")
def images() -> tuple[Features, Features]:
    """A strip of the plane, and the same farther to the right."""
    rng = np.random.default_rng(5)
    points = rng.uniform((0, 0), (1360, 600), (3000, 2))
    descriptors = rng.uniform(0, 120, (3000, 128)).round()
    left, right = points[:, 0] < SIZE[0], points[:, 0] >= SHIFT[0]
    return features(descriptors[left], points[left]), features(descriptors[right], points[right] - SHIFT)


def _some(found: Correspondences, count: int) -> Correspondences:
    """Every n-th match."""
    return found.take(np.linspace(0, len(found) - 1, count).astype(np.intp))


def _chance(features1: Features, features2: Features, count: int) -> Correspondences:
    """Matches that mean nothing."""
    rng = np.random.default_rng(1)
    indices = np.column_stack([rng.choice(len(f), count, replace=False) for f in (features1, features2)])
    return Correspondences.of(features1, features2, indices, np.full(count, 0.8))


def test_matches_in_the_overlap_are_those_of_the_whole_of_half_the_features(images: tuple[Features, Features]) -> None:
    everything = match(*images)
    for part, features in zip(overlapping(*images, _some(everything, 80)), images, strict=True):
        assert len(part) < 0.6 * len(features)
    found = match_overlap(match, *images, _some(everything, 80))
    for name in ("indices", "points1", "points2"):
        np.testing.assert_array_equal(np.sort(getattr(found, name), axis=0), np.sort(getattr(everything, name), axis=0))
    np.testing.assert_array_equal(found.points1, images[0].points[found.indices[:, 0]])
    np.testing.assert_array_equal(found.points2, images[1].points[found.indices[:, 1]])


def test_a_few_matches_by_chance_do_not_widen_it_and_many_tell_nothing(images: tuple[Features, Features]) -> None:
    some = _some(match(*images), 80)
    many, few = (Correspondences.concatenate([some, _chance(*images, count)]) for count in (30, 6))
    assert overlapping(*images, many) is None
    for clean, disturbed in zip(overlapping(*images, some), overlapping(*images, few), strict=True):
        assert len(np.setdiff1d(disturbed, clean)) < 0.1 * len(clean)


def test_few_tell_nothing(images: tuple[Features, Features]) -> None:
    everything = match(*images)
    assert overlapping(*images, _some(everything, 40)) is None
    found = match_overlap(match, *images, _some(everything, 40))
    np.testing.assert_array_equal(found.indices, everything.indices)
