"""λ by consensus."""

import math

import numpy as np
import pytest

from rdstitch.matching.distortion_consensus import vote


def test_agreement_of_votes_of_different_weight() -> None:
    rng = np.random.default_rng(0)
    std = rng.choice([0.002, 0.05], 60)
    found = vote(-0.2 + std * rng.normal(size=60), std)
    assert abs(found.distortion + 0.2) < 4 * found.std < 0.005
    assert found.agreeing >= 55
    assert found.groups == ()
    assert found.histogram.sum() == pytest.approx(1.0)
    assert len(found.edges) == len(found.histogram) + 1


def test_bad_pairs_do_not_move_the_consensus() -> None:
    rng = np.random.default_rng(1)
    votes = np.concatenate([-0.2 + 0.003 * rng.normal(size=40), rng.uniform(-0.9, 0.3, 12)])
    found = vote(votes, np.full(52, 0.003))
    assert abs(found.distortion + 0.2) < 0.004
    assert found.agreeing < 46


def test_scatter_that_covariances_do_not_explain_is_added() -> None:
    rng = np.random.default_rng(2)
    found = vote(-0.2 + 0.03 * rng.normal(size=200), np.full(200, 0.001))
    assert found.scatter == pytest.approx(0.03, rel=0.25)
    assert found.std == pytest.approx(0.03 / math.sqrt(200), rel=0.3)


def test_two_cameras_are_noticed() -> None:
    rng = np.random.default_rng(3)
    votes = np.concatenate([-0.30 + 0.005 * rng.normal(size=14), -0.10 + 0.005 * rng.normal(size=9)])
    found = vote(votes, np.full(23, 0.005))
    assert [count for _, count in found.groups] == [14, 9]
    assert [value for value, _ in found.groups] == pytest.approx([-0.30, -0.10], abs=0.01)


def test_pairs_that_cannot_see_it_have_no_vote() -> None:
    found = vote([-0.2, 0.7, np.nan], [0.01, np.inf, 0.01])
    assert found.votes == 1
    assert found.distortion == pytest.approx(-0.2)
    none = vote([0.1, 0.2], [np.inf, np.inf])
    assert math.isnan(none.distortion)
    assert math.isinf(none.std)
    assert "none of 2 pairs" in none.reason


@pytest.mark.parametrize(
    ("gap", "few", "groups"),
    [
        (0.20, 9, True),
        (0.04, 9, True),  # eight standard deviations
        (0.02, 9, False),  # four: one lens
        (0.20, 3, False),  # less than a fifth of the votes
    ],
)
def test_two_groups_are_large_and_far_apart(gap: float, few: int, groups: bool) -> None:
    rng = np.random.default_rng(4)
    votes = np.concatenate([-0.30 + 0.005 * rng.normal(size=14), -0.30 + gap + 0.005 * rng.normal(size=few)])
    assert bool(vote(votes, np.full(14 + few, 0.005)).groups) is groups


def test_votes_that_know_little_make_no_group() -> None:
    rng = np.random.default_rng(5)
    votes = np.concatenate([-0.30 + 0.005 * rng.normal(size=14), np.full(9, 0.1)])
    assert vote(votes, np.append(np.full(14, 0.005), np.full(9, 0.05))).groups == ()


def test_two_votes_have_no_scatter_and_equal_ones_a_histogram() -> None:
    assert vote([-0.2, -0.1], [0.01, 0.01]).scatter == 0.0
    same = vote([-0.2, -0.2, -0.2], [0.01] * 3)
    assert same.scatter == pytest.approx(0.0, abs=1e-6)
    assert same.edges[0] < -0.2 < same.edges[-1]
