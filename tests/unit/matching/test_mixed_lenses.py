"""Images of two lenses among one another, told apart by what the pairs see of λ."""

import itertools

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.matching.lens_votes import Votes
from rdstitch.matching.mixed_lenses import TwoLenses, two_lenses

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
    return two_lenses(cameras, Votes(i, j, votes, np.tile(covariance, (len(pairs), 1, 1))))


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
    found = two_lenses([Camera((640, 480))] * 5, Votes(i, j, votes, covariance))
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
    assert two_lenses([Camera((640, 480))] * 6, Votes(i, j, votes, np.tile(0.002**2 * np.eye(2), (15, 1, 1)))) is None


def test_lenses_that_differ_by_less_than_a_result_shows_are_one() -> None:
    assert _divided(_CHAIN, [-0.2] * 4 + [-0.185], 1e-4, size=(320, 240)) is None
    assert _divided(_CHAIN, [-0.2] * 4 + [-0.185], 1e-4, size=(640, 480)) is not None


def test_pairs_that_see_nothing_say_nothing() -> None:
    assert two_lenses([Camera((640, 480))] * 3, Votes.of([], 3.0)) is None
    assert _divided(_CHAIN[:1], [-0.2, -0.1], std=0.05) is None
