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


def test_pairs_that_cannot_see_it_have_no_vote() -> None:
    found = vote([-0.2, 0.7, np.nan], [0.01, np.inf, 0.01])
    assert found.votes == 1
    assert found.distortion == pytest.approx(-0.2)
    none = vote([0.1, 0.2], [np.inf, np.inf])
    assert math.isnan(none.distortion)
    assert math.isinf(none.std)
    assert "none of 2 pairs" in none.reason


@pytest.mark.parametrize(("offset", "agreeing", "distortion"), [(0.029, 2, -0.1855), (0.031, 1, -0.2)])
def test_votes_agree_within_three_standard_deviations(offset: float, agreeing: int, distortion: float) -> None:
    found = vote([-0.2, -0.2 + offset], [0.01, 0.01])
    assert found.agreeing == agreeing
    assert found.distortion == pytest.approx(distortion)


def test_the_middle_of_votes_that_do_not_agree_is_their_median() -> None:
    assert vote([-0.5, -0.2, 0.1], [0.001] * 3).distortion == pytest.approx(-0.2, abs=0.01)
    assert vote([0.1, -0.6, -0.2, -0.5, 0.2], [0.001] * 5).distortion == pytest.approx(-0.2, abs=0.01)
