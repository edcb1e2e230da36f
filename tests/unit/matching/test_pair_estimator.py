"""Rounds of estimator: what rests does not hide what moves; pairs that hang on little find more where it must be."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from examples.worlds.correspondences import stored
from rdstitch.arrays import FloatArray
from rdstitch.features import Correspondences, Features, match
from rdstitch.geometry.camera import Camera
from rdstitch.matching.candidate_pairs import loop_closures, prescreen_pairs
from rdstitch.matching.feature_store import FeatureStore
from rdstitch.matching.pair_estimator import FeatureMatching, PairEstimator
from rdstitch.matching.static_background import (
    is_static_pair,
    moving_features,
    without_static_background,
)
from rdstitch.matching.two_view import EstimationTask
from rdstitch.robust import EstimationOptions
from rdstitch.system.progress import silent

LENS = Camera((640, 480), distortion=-0.2, focal=520.0)
IMAGES = 4


def test_a_pair_is_as_sure_of_the_focal_length_as_its_camera() -> None:
    camera = Camera((640, 480), focal=500.0, focal_source="file", focal_std=75.0)
    pair = EstimationTask(camera, camera, stored(np.zeros((9, 2)), np.zeros((9, 2))), None, None).pair_matches()
    assert (pair.camera1.focal_log_std, pair.camera2.focal_log_std) == (0.15, 0.15)


def _features(points: FloatArray, descriptors: FloatArray) -> Features:
    count = len(points)
    one = np.ones(count)
    return Features(points, descriptors.astype(np.float32), one, one, one, None, "rootsift", LENS.image_size)


def _estimator(resting: int, moving: int, repeated: int = 0, seed: int = 0) -> PairEstimator:
    """Images in which some points rest, while a board with others is carried about, or is not there.

    Of the points of the board so many look like one another, in fives.
    """
    rng = np.random.default_rng(seed)
    background = rng.uniform((0, 0), (639, 479), (resting, 2))
    board = rng.uniform(-0.5, 0.5, (moving, 2)) * 1.2
    names = rng.normal(size=(resting + moving, 64))
    names /= np.linalg.norm(names, axis=1, keepdims=True)
    names[resting : resting + repeated] = np.repeat(names[resting : resting + repeated : 5], 5, axis=0)
    found = []
    for index in range(IMAGES):
        angle, offset = 0.3 * index, np.array([0.12, -0.08]) * index
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        seen = board @ turn.T + offset
        flat = seen / (1.0 + seen @ np.array([0.1 * index, 0.05 * index]))[:, None]
        points = np.concatenate([background, LENS.distort(LENS.denormalize(flat / 2.0 * 1.2))])
        points += rng.normal(scale=0.2, size=points.shape)
        seen_as = names + rng.normal(scale=0.01, size=names.shape)
        inside = ((points > 0) & (points < (639, 479))).all(axis=1)
        found.append(_features(points[inside], seen_as[inside]))
    cameras, matching = [LENS.with_guessed_focal()] * IMAGES, FeatureMatching(partial(match, ratio=None))
    options, executor = EstimationOptions(select_below=50), ThreadPoolExecutor(1)
    return PairEstimator(FeatureStore.of(found), cameras, matching, options, silent, executor)


ALL = [(i, j) for i in range(IMAGES) for j in range(i + 1, IMAGES)]


def test_a_moving_board_is_found_before_a_static_background() -> None:
    estimator = _estimator(400, 150)
    alone = estimator.estimate(ALL)
    assert all(is_static_pair(pair, 3.0) for pair in alone)
    moving = without_static_background(estimator, alone)
    assert all(pair.relation and not is_static_pair(pair, 3.0) for pair in moving[1])
    distortion = np.median([pair.relation.distortion for pair in moving[1]])
    assert abs(distortion - LENS.distortion) < 0.02


@pytest.mark.parametrize(("resting", "moving"), [(400, 0), (4, 300)])
def test_images_that_are_really_static_stay_together_and_a_few_static_matches_change_nothing(
    resting: int, moving: int
) -> None:
    estimator = _estimator(resting, moving)
    alone = estimator.estimate(ALL)
    assert without_static_background(estimator, alone) is None
    assert {is_static_pair(pair, 3.0) for pair in alone} == {moving == 0}


def test_an_overlay_is_removed_though_every_pair_moves() -> None:
    estimator = _estimator(40, 300)
    alone = estimator.estimate(ALL)
    assert not any(is_static_pair(pair, 3.0) for pair in alone)
    moving = without_static_background(estimator, alone)
    for before, after in zip(alone, moving[1], strict=True):
        assert len(after.correspondences) <= len(before.correspondences) - 35
        assert after.relation.inliers.sum() >= 0.95 * before.relation.inliers.sum()


def test_static_features_that_were_matched_otherwise_are_dropped_too() -> None:
    estimator = _estimator(40, 300)
    alone = estimator.estimate(ALL)
    wrong = [pair for pair in alone if pair.images != (0, 1)]  # image 0 has its static matches with others
    left = moving_features(estimator.features, wrong, 3.0)
    for before, after in zip(estimator.features, left, strict=True):
        assert len(before) - 48 <= len(after) <= len(before) - 38


def test_images_that_share_nothing_are_rejected_by_the_prescreen() -> None:
    one, other = _estimator(0, 400), _estimator(0, 400, seed=1)
    together = replace(one, features=FeatureStore((*one.features.items[:2], *other.features.items[:2])))
    assert list(prescreen_pairs(together, ALL)) == [(0, 1), (2, 3)]


def test_a_few_matches_beside_hundreds_do_not_pass_the_prescreen() -> None:
    shared = {(0, 1): 300, (0, 2): 16, (0, 3): 14, (1, 2): 400, (1, 3): 7, (2, 3): 200}
    estimator = _estimator(0, 400)
    # Told apart by their number of features.
    several = [found.take(np.arange(100 + index)) for index, found in enumerate(estimator.features)]

    def matcher(one: Features, two: Features) -> Correspondences:
        count = shared[len(one) - 100, len(two) - 100]
        points = np.zeros((count, 2))
        return Correspondences(points.astype(np.intp), points, points, points[:, 0])

    known = replace(estimator, features=FeatureStore.of(several), matching=FeatureMatching(matcher))
    # The most that they share with another: 300, 400, 400 and 200.
    assert list(prescreen_pairs(known, ALL)) == [(0, 1), (0, 2), (0, 3), (1, 2), (2, 3)]
    shared[0, 3], shared[0, 2] = 9, 14
    assert list(prescreen_pairs(known, ALL)) == [(0, 1), (1, 2), (2, 3)]


def test_images_behind_the_horizon_have_no_neighbours() -> None:
    beyond = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    assert loop_closures([LENS] * 3, np.stack([beyond] * 3), set()) == []
    assert loop_closures([LENS] * 3, np.stack([np.eye(3), beyond, beyond]), set()) == []
    assert loop_closures([LENS] * 3, np.stack([np.eye(3), np.eye(3), beyond]), set()) == [(0, 1)]


def test_with_a_static_background_every_candidate_pair_is_compared() -> None:
    estimator = _estimator(400, 150)
    # What is static has chosen these.
    few = [pair for pair in ALL if 0 in pair]
    moving = without_static_background(estimator, estimator.estimate(few), ALL)
    assert [(pair.image1, pair.image2) for pair in moving[1]] == ALL
