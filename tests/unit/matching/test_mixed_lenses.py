"""Votes of pairs on λ: the lens they agree on, lenses that are mixed, and what too few votes say."""

import itertools
import math
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from examples.worlds.correspondences import stored
from rdstitch.arrays import FloatArray
from rdstitch.executors import ProcessExecutor
from rdstitch.geometry.camera import Camera
from rdstitch.matching import lens_votes
from rdstitch.matching.distortion_consensus import vote
from rdstitch.matching.lens_votes import LensVotes
from rdstitch.matching.mixed_lenses import TwoLenses, separate_lenses, two_lenses
from rdstitch.matching.two_view import PairRegistration
from rdstitch.robust import estimate_radial_homography

LENS = Camera((640, 480), -0.2, focal=520.0)


@pytest.mark.parametrize(("count", "votes"), [(20, 0), (29, 0), (30, 1), (120, 1)])
def test_few_inliers_have_no_vote(count: int, votes: int) -> None:
    pair = _pair(0, 1, count)
    assert pair.relation.inliers.all()
    assert len(_voted([pair])) == votes


def _voted(pairs: list[PairRegistration], executor: Executor | None = None) -> LensVotes:
    with executor or ThreadPoolExecutor(1) as opened:
        return LensVotes.of(pairs, 3.0, opened)


def test_votes_are_the_same_by_any_number_of_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lens_votes, "_PAIRS_AT_ONCE", 2)
    pairs = [_pair(k, k + 1, 40 + k) for k in range(5)]
    one, several = _voted(pairs), _voted(pairs, ProcessExecutor(2))
    assert one.image1.tolist() == several.image1.tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(one.distortion, several.distortion)
    np.testing.assert_array_equal(one.covariance, several.covariance)


def _pair(i: int, j: int, count: int, lens1: Camera = LENS, lens2: Camera = LENS) -> PairRegistration:
    rng = np.random.default_rng(count)
    points1 = rng.uniform((150.0, 100.0), (490.0, 380.0), (count, 2))
    flat = lens1.undistort(points1)
    points2 = lens2.distort(flat @ np.array([[0.96, 0.28], [-0.28, 0.96]]).T + (-130.0, 110.0))
    points2 += rng.normal(scale=0.1, size=points2.shape)
    relation = estimate_radial_homography(points1, points2, LENS.image_size, focal=520.0)
    return PairRegistration(i, j, stored(points1, points2), relation)


def test_images_without_votes_go_with_whichever_lens_is_kept() -> None:
    first, second = LENS, replace(LENS, distortion=-0.1)
    pairs = [_pair(i, j, 80, first, first) for i, j in ((0, 1), (0, 2), (1, 2))]
    pairs += [_pair(i, j, 120, second, second) for i, j in ((3, 4), (3, 5), (4, 5))]
    pairs += [_pair(2, 3, 90, first, second), _pair(1, 4, 90, first, second)]
    few = [_pair(5, 6, 20, second, second), _pair(6, 7, 20, second, second), _pair(0, 8, 20, first, first)]
    with ThreadPoolExecutor(1) as executor:
        mixed, left_out = separate_lenses([LENS] * 9, [*pairs, *few], 3.0, None, executor)
    assert mixed.certain
    assert left_out.keys() == {0, 1, 2}


def _votes(distortion: list[list[float]], covariance: FloatArray) -> LensVotes:
    count = len(distortion)
    chain = np.arange(count)
    return LensVotes(chain, chain + 1, np.array(distortion), np.tile(covariance, (count, 1, 1)))


OWN = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])


def test_what_both_images_have_in_common_counts_little() -> None:
    alike, unlike = _votes([[-0.15, -0.15]], OWN), _votes([[-0.15, -0.25]], OWN)
    assert 2.0 * alike.mahalanobis_residuals(-0.2)[0] < unlike.mahalanobis_residuals(-0.2)[0]


def test_lenses_are_fitted_to_their_votes_by_least_sums_of_distances() -> None:
    rng = np.random.default_rng(0)
    first, second = -0.2 + 0.004 * rng.normal(size=(2, 60))
    votes = _votes(np.stack([first, second + 0.1], axis=1).tolist(), 1e-5 * np.eye(2))
    which = np.tile([0, 1], (60, 1))
    found = votes.fitted(which, np.array([0.0, 0.0, 0.7]))
    assert found[1] - found[0] == pytest.approx(0.1, abs=0.003)
    assert found[2] == 0.7  # no vote: it stays
    # One vote far off hardly moves the lenses: distances count, not their squares.
    spoiled = _votes([*votes.distortion[:59].tolist(), [0.9, -0.9]], 1e-5 * np.eye(2))
    assert np.abs(spoiled.fitted(which, np.array([0.0, 0.0])) - found[:2]).max() < 0.01


_CHAIN = [(0, 1), (1, 2), (2, 3), (3, 4)]
_ALL = list(itertools.combinations(range(6), 2))
_ROW = list(itertools.pairwise(range(40)))
_FIELD = [(k, k + step) for k in range(90) for step in (1, 10) if (k % 10, step) != (9, 1)]  # 10 rows of 10


def _divided(
    pairs: list[tuple[int, int]],
    lenses: list[float],
    std: float = 0.001,
    *,
    common: float = 0.01,
    seed: int = 1,
    size: tuple[int, int] = (640, 480),
) -> TwoLenses | None:
    """The division by votes of pairs: off by ``common`` for both images, and by ``std`` for each."""
    i, j = np.array(pairs).T
    rng, own = np.random.default_rng(seed), np.array(lenses)
    votes = np.stack([own[i], own[j]], axis=1)
    votes += common * rng.standard_normal((len(pairs), 1)) + std * rng.standard_normal((len(pairs), 2))
    covariance = common**2 + std**2 * np.eye(2)
    cameras = [Camera(size)] * len(lenses)
    return two_lenses(cameras, LensVotes(i, j, votes, np.tile(covariance, (len(pairs), 1, 1))))


@pytest.mark.parametrize(
    ("pairs", "lenses"),
    [
        (_CHAIN, [-0.2, -0.2, -0.2, -0.16, -0.16]),
        (_CHAIN, [-0.05, -0.05, -0.3, -0.3, -0.3]),
        (_CHAIN, [-0.2, -0.2, -0.2, -0.2, -0.15]),
        (_CHAIN, [-0.2, -0.2, -0.15, -0.2, -0.2]),
        (_CHAIN[:3], [-0.2, -0.2, -0.2, -0.25]),
        (_CHAIN[:2], [-0.15, -0.2, -0.2]),
        (_ALL, [-0.2, -0.1, -0.2, -0.1, -0.2, -0.1]),
        (_ROW, [-0.2] * 39 + [-0.15]),
        (_ROW, [-0.2] * 26 + [-0.15] * 14),
        (_FIELD, [-0.15] + [-0.2] * 99),
        (_FIELD, [-0.15] * 40 + [-0.2] * 60),
    ],
)
def test_two_lenses_are_separated(pairs: list[tuple[int, int]], lenses: list[float]) -> None:
    found = _divided(pairs, lenses)
    assert found.certain
    np.testing.assert_allclose(np.where(found.second, found.distortion[1], found.distortion[0]), lenses, atol=0.02)
    fewer = {value for value in lenses if lenses.count(value) <= len(lenses) / 2}
    assert {lenses[k] for k in np.flatnonzero(found.second)} <= fewer


@pytest.mark.parametrize(("pairs", "lenses"), [(_CHAIN[:1], [-0.2, -0.15]), (_CHAIN[:2], [-0.2, -0.1, -0.2])])
def test_where_no_pair_is_of_one_lens_nothing_can_be_kept(pairs: list[tuple[int, int]], lenses: list[float]) -> None:
    found = _divided(pairs, lenses)
    assert not found.certain


def test_an_image_that_may_belong_to_either_makes_the_division_uncertain() -> None:
    i, j = np.array(_CHAIN).T
    votes = np.array([(-0.2, -0.2), (-0.2, -0.05), (-0.05, -0.05), (-0.05, -0.13)])
    std = np.array([0.001, 0.001, 0.001, 0.05])
    covariance = std[:, None, None] ** 2 * np.eye(2)
    found = two_lenses([Camera((640, 480))] * 5, LensVotes(i, j, votes, covariance))
    assert not found.certain


@pytest.mark.parametrize("common", [0.001, 0.01, 0.1])
@pytest.mark.parametrize("std", [0.0003, 0.005, 0.05])
@pytest.mark.parametrize("pairs", [_CHAIN[:1], _CHAIN[:2], _CHAIN, _ALL])
def test_one_lens_is_one_however_its_votes_scatter(pairs: list[tuple[int, int]], std: float, common: float) -> None:
    divided = [_divided(pairs, [-0.2] * 6, std, common=common, seed=seed) for seed in range(10)]
    assert divided == [None] * 10


def test_a_few_wrong_votes_are_no_lens() -> None:
    i, j = np.array(_ALL).T
    votes = np.full((len(_ALL), 2), -0.2)
    votes[2], votes[7] = (0.05, 0.04), (-0.4, -0.2)
    assert (
        two_lenses([Camera((640, 480))] * 6, LensVotes(i, j, votes, np.tile(0.002**2 * np.eye(2), (15, 1, 1)))) is None
    )


def test_lenses_that_differ_by_less_than_a_result_shows_are_one_and_pairs_that_see_nothing_say_nothing() -> None:
    assert two_lenses([Camera((640, 480))] * 3, _voted([])) is None
    assert _divided(_CHAIN[:1], [-0.2, -0.1], std=0.05) is None
    assert _divided(_CHAIN, [-0.2] * 4 + [-0.185], 1e-4, size=(320, 240)) is None
    assert _divided(_CHAIN, [-0.2] * 4 + [-0.185], 1e-4, size=(640, 480)) is not None


def test_agreement_of_votes_of_different_weight() -> None:
    rng = np.random.default_rng(0)
    std = rng.choice([0.002, 0.05], 60)
    found = vote(-0.2 + std * rng.normal(size=60), std)
    assert abs(found.distortion + 0.2) < 4 * found.std < 0.005
    assert found.agreeing.sum() >= 55
    # Bad pairs do not move the consensus.
    rng = np.random.default_rng(1)
    votes = np.concatenate([-0.2 + 0.003 * rng.normal(size=40), rng.uniform(-0.9, 0.3, 12)])
    found = vote(votes, np.full(52, 0.003))
    assert abs(found.distortion + 0.2) < 0.004
    assert found.agreeing.sum() < 46


def test_scatter_that_covariances_do_not_explain_is_added() -> None:
    rng = np.random.default_rng(2)
    found = vote(-0.2 + 0.03 * rng.normal(size=200), np.full(200, 0.001))
    assert found.scatter == pytest.approx(0.03, rel=0.25)
    assert found.std == pytest.approx(0.03 / math.sqrt(200), rel=0.3)


def test_pairs_that_cannot_see_it_have_no_vote() -> None:
    found = vote([-0.2, 0.7, np.nan], [0.01, np.inf, 0.01])
    assert len(found.votes) == 1
    assert found.distortion == pytest.approx(-0.2)
    none = vote([0.1, 0.2], [np.inf, np.inf])
    assert math.isnan(none.distortion)
    assert math.isinf(none.std)
    assert not len(none.votes)


def test_votes_agree_within_three_standard_deviations_and_others_have_their_median() -> None:
    for offset in (0.029, 0.031, 0.6):  # of two that contradict each other, neither is more likely
        found = vote([-0.2, -0.2 + offset], [0.01, 0.01])
        assert found.agreeing.sum() == 2
        assert found.distortion == pytest.approx(-0.2 + offset / 2)
        assert found.std == pytest.approx(offset / 2)
    assert vote([-0.5, -0.2, 0.1], [0.001] * 3).distortion == pytest.approx(-0.2, abs=0.01)
    assert vote([0.1, -0.6, -0.2, -0.5, 0.2], [0.001] * 5).distortion == pytest.approx(-0.2, abs=0.01)


def test_one_pair_that_is_surer_than_the_others_does_not_overturn_them() -> None:
    found = vote([0.1, 0.1, 0.1, -0.5], [0.01, 0.01, 0.01, 0.005])
    assert found.distortion == pytest.approx(0.1)
    assert found.agreeing.tolist() == [True, True, True, False]
