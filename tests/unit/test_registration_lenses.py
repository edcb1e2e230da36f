"""Pictures of two lenses among one another, told apart by what the pairs see of λ."""

import itertools

import numpy as np
import pytest

from rdstitch.registration.lenses import TwoLenses, Votes, two_lenses

_CHAIN = [(0, 1), (1, 2), (2, 3), (3, 4)]
_ALL = list(itertools.combinations(range(6), 2))


def _divided(pairs: list[tuple[int, int]], lenses: list[float], scatter: float, seed: int = 1) -> TwoLenses | None:
    """The division by votes of pairs, scattered about the mean λ of their two pictures."""
    i, j = np.array(pairs).T
    own = np.array(lenses)
    votes = (own[i] + own[j]) / 2 + scatter * np.random.default_rng(seed).standard_normal(len(pairs))
    return two_lenses(len(lenses), Votes(i, j, votes, np.full(len(pairs), scatter)))


@pytest.mark.parametrize(
    ("pairs", "lenses"),
    [
        (_CHAIN, [-0.2, -0.2, -0.2, -0.17, -0.17]),
        (_CHAIN, [-0.05, -0.05, -0.3, -0.3, -0.3]),
        (_ALL, [-0.2, -0.1, -0.2, -0.1, -0.2, -0.1]),
    ],
)
def test_two_lenses_are_told_apart(pairs: list[tuple[int, int]], lenses: list[float]) -> None:
    found = _divided(pairs, lenses, 0.0003)
    assert found is not None
    assert found.certain
    assert set(found.second.tolist()) == {False, True}
    np.testing.assert_allclose(np.where(found.second, found.distortion[1], found.distortion[0]), lenses, atol=0.002)


def test_one_picture_in_the_middle_may_be_that_of_the_other_lens_or_not() -> None:
    found = _divided(_CHAIN, [-0.2, -0.2, -0.05, -0.2, -0.2], 0.0003)
    assert found is not None
    assert not found.certain


@pytest.mark.parametrize("scatter", [0.0003, 0.005, 0.05])
@pytest.mark.parametrize("pairs", [_CHAIN, _ALL])
def test_one_lens_is_one_however_its_votes_scatter(pairs: list[tuple[int, int]], scatter: float) -> None:
    divided = [_divided(pairs, [-0.2] * 6, scatter, seed) for seed in range(20)]
    assert divided == [None] * 20


def test_a_few_wrong_votes_are_no_lens() -> None:
    i, j = np.array(_ALL).T
    votes = np.full(len(_ALL), -0.2)
    votes[[2, 7]] = 0.05, -0.4
    assert two_lenses(6, Votes(i, j, votes, np.full(len(_ALL), 0.002))) is None


def test_too_few_votes_say_nothing() -> None:
    assert _divided(_CHAIN[:3], [-0.2, -0.2, -0.1, -0.1], 0.0003) is None
