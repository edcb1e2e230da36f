"""Candidate pairs, and the features that they are chosen by."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from examples.worlds.correspondences import stored
from rdstitch.arrays import FloatArray
from rdstitch.features import Features
from rdstitch.features.keypoints import Descriptors
from rdstitch.geometry.camera import Camera
from rdstitch.matching.candidate_pairs import CANDIDATES, loop_closures, select_pairs
from rdstitch.matching.candidate_pairs import first_pairs as _first_pairs
from rdstitch.matching.feature_store import FeatureStore, StoredMatches
from rdstitch.system.cache import Cache


def first_pairs(features: list[Features], seed: int, positions: FloatArray | None = None) -> list[tuple[int, int]]:
    return _first_pairs(FeatureStore.of(features), seed, positions)


def _features(descriptors: Descriptors) -> Features:
    count = len(descriptors)
    ones = np.ones(count)
    places = np.random.default_rng(count).uniform(0.0, 500.0, (count, 2))
    return Features(places, descriptors, ones, np.zeros(count), ones, None, "made up")


def _drive(count: int, binary: bool = False) -> list[Features]:
    """A path that is driven twice: each frame shows a slice of a strip of descriptors, half of it also the next."""
    rng = np.random.default_rng(5)
    strip = rng.normal(size=(count // 2 * 100 + 100, 64)).astype(np.float32)
    if binary:
        strip = rng.integers(0, 256, strip.shape).astype(np.uint8)
    frames = []
    for index in range(count):
        start = 100 * (index % (count // 2))
        seen = strip[start : start + 200][rng.permutation(200)]
        noise = 0.1 * rng.normal(size=seen.shape)
        frames.append(_features(seen if binary else (seen + noise).astype(np.float32)))
    return frames


@pytest.mark.parametrize("binary", [False, True])
def test_frames_of_the_same_place_are_paired_however_far_apart(binary: bool) -> None:
    count = 48
    pairs = set(first_pairs(_drive(count, binary), seed=0))
    again = {(index, index + count // 2) for index in range(count // 2)}
    following = {(index, index + 1) for index in range(count - 1)}
    assert following < pairs
    assert len(again & pairs) >= 0.9 * len(again)


def _survey(side: int, order: NDArray[np.intp]) -> tuple[list[Features], set[tuple[int, int]]]:
    """Images of a plane, side by side, half over one another, in some order; pairs that overlap by a quarter."""
    rng = np.random.default_rng(8)
    corners = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2) * 0.5
    corners = corners[order] + rng.uniform(-0.02, 0.02, (side**2, 2))
    places = rng.uniform(0.0, side / 2 + 1.0, ((10 * side) ** 2, 2))
    words = rng.normal(size=(len(places), 64)).astype(np.float32)
    images = []
    for corner in corners:
        seen = words[((places > corner) & (places < corner + 1.0)).all(axis=1)]
        repeated = seen[rng.random(len(seen)) < 0.7]  # no detector finds all of them again
        images.append(_features(repeated + 0.3 * rng.normal(size=repeated.shape).astype(np.float32)))
    shared = np.maximum(1.0 - np.abs(corners[:, None] - corners), 0.0).prod(axis=2)
    return images, {(i, j) for i, j in np.argwhere(shared > 0.22).tolist() if i < j}


@pytest.mark.parametrize("ordered", [False, True])
def test_pairs_that_overlap_are_among_fifteen_candidates_an_image(ordered: bool) -> None:
    side = 16
    order = np.arange(side**2) if ordered else np.random.default_rng(3).permutation(side**2)
    images, overlapping = _survey(side, order)
    pairs = set(first_pairs(images, seed=0))
    assert len(overlapping) > 3 * side**2
    assert 2 * len(pairs) <= CANDIDATES * side**2
    assert len(overlapping & pairs) >= 0.997 * len(overlapping)


def test_the_order_of_images_counts_only_where_it_means_something() -> None:
    side = 9
    following = {(i, i + 3) for i in range(side**2 - 3)}
    ordered, _ = _survey(side, np.arange(side**2))
    assert following < set(first_pairs(ordered, seed=0))
    shuffled, _ = _survey(side, np.random.default_rng(4).permutation(side**2))
    assert not following < set(first_pairs(shuffled, seed=0))


def test_images_taken_near_each_other_are_paired_whatever_they_look_like() -> None:
    rng = np.random.default_rng(0)
    count = 60
    images = [_features(rng.normal(size=(30, 64)).astype(np.float32)) for _ in range(count)]
    turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    positions = np.column_stack([np.cos(turn), np.sin(turn)])[rng.permutation(count)]
    positions[7] = np.nan
    pairs = set(first_pairs(images, seed=0, positions=positions))
    near = np.linalg.norm(positions[:, None] - positions, axis=2) < 0.35
    assert {(i, j) for i, j in np.argwhere(near).tolist() if i < j} < pairs
    assert len({pair for pair in pairs if 7 in pair}) < count - 1


def test_images_without_features_look_like_none() -> None:
    nothing = _features(np.zeros((0, 64), dtype=np.float32))
    pairs = first_pairs([nothing, *_drive(34)], seed=1)
    assert len(pairs) > 34
    assert [pair for pair in pairs if 0 in pair] == [(0, 1), (0, 2), (0, 3)]


@pytest.mark.parametrize(("overlap", "found"), [(0.1, []), (0.2, [(0, 1)]), (0.5, [(0, 1)]), (0.9, [(0, 1)])])
@pytest.mark.parametrize("size", [1.0, 0.4])
def test_images_that_overlap_by_a_fifth_are_neighbours(overlap: float, found: list[object], size: float) -> None:
    """Of the smaller footprint: the second image may have been taken from nearer."""
    lens = Camera((640, 480))
    width, height = 639 / lens.scale, 479 / lens.scale
    x = (0.5 - size * (overlap - 0.5)) * width
    shifted = np.array([[size, 0.0, x], [0.0, size, (1 - size) * height / 4], [0.0, 0.0, 1.0]])
    assert loop_closures([lens, lens], np.stack([np.eye(3), shifted]), set()) == found
    assert loop_closures([lens, lens], np.stack([np.eye(3), shifted]), {(0, 1)}) == []


def _shared_by_squares(side: int) -> dict[tuple[int, int], StoredMatches]:
    """A survey of side x side images of 400 pixels, each 100 pixels from the next: one match every 20 pixels."""
    rng = np.random.default_rng(0)
    places = rng.uniform(0.0, 100.0 * side + 300.0, ((5 * side + 15) ** 2, 2))
    corners = [np.array([100.0 * column, 100.0 * row]) for row in range(side) for column in range(side)]
    seen = [((places - corner >= 0.0) & (places - corner < 400.0)).all(axis=1) for corner in corners]
    shared = {}
    for j, corner2 in enumerate(corners):
        for i, corner1 in enumerate(corners[:j]):
            both = places[seen[i] & seen[j]]
            if len(both) > 8:
                shared[i, j] = stored(both - corner1, both - corner2)
    return shared


def test_of_many_overlapping_pairs_each_image_keeps_a_few_all_around_it() -> None:
    side = 7
    shared = _shared_by_squares(side)
    chosen = select_pairs(shared, [Camera((400, 400))] * side**2)
    degree = np.bincount(np.ravel(list(chosen)), minlength=side**2)
    assert len(shared) > 12 * side**2
    assert degree.min() >= 6
    assert degree.mean() < 10
    middle = side**2 // 2
    beside = {other for pair in chosen if middle in pair for other in pair}
    directions = {(int(np.sign(k % side - middle % side)), int(np.sign(k // side - middle // side))) for k in beside}
    assert {(1, 0), (-1, 0), (0, 1), (0, -1)} <= directions


def test_a_weak_partner_on_the_other_side_is_kept_before_a_strong_one_on_the_same() -> None:
    rng = np.random.default_rng(1)
    right, left = rng.uniform((200, 0), (400, 400), (60, 2)), rng.uniform((0, 0), (100, 400), (25, 2))
    shared = {(0, other): stored(right, right) for other in range(1, 12)}
    # The others have partners enough among themselves.
    many = np.tile(right, (4, 1))
    shared |= {(i, j): stored(many, many) for i in range(1, 12) for j in range(i + 1, 12)}
    shared[0, 12] = stored(left, left)
    chosen = select_pairs(shared, [Camera((400, 400))] * 13)
    assert (0, 12) in chosen
    assert sum(0 in pair for pair in chosen) == 6


def test_neighbours_with_partners_in_common_are_not_tried_again_but_loops_are_closed() -> None:
    """Frames along a line that nearly overlaps itself: all poses alike, so that all are neighbours."""
    count = 20
    homographies = np.tile(np.eye(3), (count, 1, 1))
    tried = {(i, j) for i in range(count) for j in range(i + 1, min(i + 7, count))}
    found = loop_closures([Camera((640, 480))] * count, homographies, tried)
    assert found
    assert all(j - i > 12 or i < 6 or j > count - 7 for i, j in found)


def test_pairs_that_failed_make_no_partners_and_are_not_tried_again() -> None:
    """Two rows of a survey, registered along the rows only."""
    row, camera = 20, Camera((640, 480))
    homographies = np.tile(np.eye(3), (2 * row, 1, 1))
    homographies[:, 0, 2], homographies[:, 1, 2] = np.tile(np.arange(row) * 0.3, 2), np.repeat([0.0, 0.6], row)
    along = {(i, j) for i in range(2 * row) for j in range(i + 1, i + 4) if j < (i // row + 1) * row}
    failed = {(k, row + k + 3) for k in range(row - 3)} | {(k, row + k - 3) for k in range(3, row)}
    untouched, found = (loop_closures([camera] * 2 * row, homographies, along, without) for without in (set(), failed))
    assert {(k, row + k) for k in range(row)} <= set(found)
    assert set(found) == set(untouched) - failed


@pytest.mark.parametrize("focal", [0.4, 1.0, 4.0])
def test_of_a_turn_neighbours_are_those_that_see_a_part_of_each_other(focal: float) -> None:
    """A full circle: the next images, as far as their angle of view reaches, also across where the circle closes."""
    count, camera = 36, Camera((640, 480))
    turned = Rotation.from_rotvec(np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)[:, None] * [0, 1, 0]).as_matrix()
    found = loop_closures([camera] * count, turned @ np.diag([1.0, 1.0, focal]), set(), on_sphere=True)
    half = np.degrees(np.arctan2(320.0, focal * camera.scale))
    reach = min(5, int(2.0 * half * 0.8 // 10.0))
    assert reach >= 1
    apart = {min((j - i) % count, (i - j) % count) for i, j in found}
    assert apart == set(range(1, max(apart) + 1))
    assert abs(max(apart) - reach) <= 1
    assert (0, count - 1) in found


def test_cameras_of_their_own_are_not_compared_with_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    cameras, compared, equal = [Camera((640, 480), focal=500.0 + k) for k in range(60)], list[Camera](), Camera.__eq__

    def counted(one: Camera, other: object) -> bool:
        compared.append(one)
        return equal(one, other)

    monkeypatch.setattr(Camera, "__eq__", counted)
    places = np.tile(np.eye(3), (60, 1, 1))
    places[:, 0, 2] = np.arange(60.0)
    loop_closures(cameras, places, set())
    assert len(compared) < 200


def _some_features(count: int, size: tuple[int, int]) -> Features:
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.5, -0.5), np.array(size) - 0.5, (count, 2))
    numbers = np.arange(float(count))
    descriptors = rng.integers(0, 9, (count, 8)).astype(np.float32)
    return Features(points, descriptors, numbers, numbers, -numbers, None, "x", size)


def test_features_are_read_in_the_pixels_that_are_wanted() -> None:
    features = _some_features(30, (801, 600))
    (smaller,) = FeatureStore.of([features]).at_sizes([(401, 300)])
    assert smaller.image_size == (401, 300)
    # The corners of the images stay where they are, and so do half diagonals.
    ratio = np.hypot(401, 300) / np.hypot(801, 600)
    np.testing.assert_allclose(smaller.points, (features.points - (400, 299.5)) * ratio + (200, 149.5), atol=0.4)
    np.testing.assert_allclose(smaller.scale, features.scale * ratio, rtol=2e-3)
    np.testing.assert_array_equal(smaller.descriptors, features.descriptors)


def test_chosen_features_keep_their_order_and_the_strongest_come_first(tmp_path: Path) -> None:
    store = FeatureStore.of([_some_features(30, (640, 480))])
    chosen = FeatureStore((store.items[0].take(np.array([7, 3, 20])),))
    assert chosen[0].scale.tolist() == [7, 3, 20]
    assert FeatureStore((chosen.items[0].take(np.array([2, 0])),))[0].scale.tolist() == [20, 7]
    assert chosen.strongest(2)[0].scale.tolist() == [7, 3]
    assert chosen.strongest(2).counts.tolist() == [2]
    assert chosen.strongest(5).counts.tolist() == [3]
    assert store.strongest(4)[0].scale.tolist() == [0, 1, 2, 3]
    # What is chosen is part of the key.
    item, cache = store.items[0], Cache.at(tmp_path)
    others = [item.take(np.arange(5)), item.take(np.arange(6))]
    assert len({entry.key(cache) for entry in (item, *others)}) == 3
    assert item.key(cache) == FeatureStore.of([_some_features(30, (640, 480))]).items[0].key(cache)


def test_matches_are_read_in_the_pixels_that_are_wanted() -> None:
    points = np.array([[0.0, 0.0], [639.0, 479.0]])
    matches = stored(points, points[::-1].copy())
    assert len(matches) == 2
    larger = matches.resized(((640, 480), (640, 480)), ((1280, 960), (640, 480))).load()
    np.testing.assert_allclose(larger.points1, [[0.5, 0.5], [1278.5, 958.5]], atol=0.01)
    np.testing.assert_array_equal(larger.points2, points[::-1])
