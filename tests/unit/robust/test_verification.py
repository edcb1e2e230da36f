"""Whether agreement is more than chance: the two tests at their limits."""

import numpy as np
import pytest
from scipy.stats import binom

from rdstitch.arrays import FloatArray
from rdstitch.robust.verification import MIN_PLACES, binomial_tail, places, rejection_reason

SIZE = (1000, 800)
CELL = np.hypot(*SIZE) / 32


def _apart(count: int) -> FloatArray:
    """Points in as many different cells."""
    column, row = np.arange(count) % 24, np.arange(count) // 24
    return np.asarray((np.stack([column, row], axis=1) + 0.5) * CELL)


@pytest.mark.parametrize(("matches", "threshold"), [(60, 3.0), (400, 3.0), (400, 30.0)])
def test_chance_is_that_of_a_wrong_match_near_its_place(matches: int, threshold: float) -> None:
    """With ``p = π t² / area + 0.01``; four matches make the model, and agree by construction."""
    p = np.pi * threshold**2 / (SIZE[0] * SIZE[1]) + 0.01
    tail = binom.sf(np.arange(matches - 4) - 1, matches - 4, p)  # of as many or more
    enough = int(np.argmax(tail <= 1e-4)) + 4
    points = _apart(matches)
    for count, reliable in ((enough, True), (enough - 1, False)):
        reason = rejection_reason(points, points, np.arange(matches) < count, SIZE, threshold)
        if count >= MIN_PLACES:
            assert (reason is None) is reliable, count


def test_few_matches_that_all_agree_are_no_chance() -> None:
    points = _apart(MIN_PLACES)
    assert rejection_reason(points, points, np.ones(len(points), dtype=np.bool_), SIZE, 3.0) is None


def test_a_wide_threshold_is_taken_for_even_odds_at_most() -> None:
    points = _apart(100)
    wide = 1e4
    enough = int(np.argmax(binom.sf(np.arange(96) - 1, 96, 0.5) <= 1e-4)) + 4
    reasons = [rejection_reason(points, points, np.arange(100) < n, SIZE, wide) for n in (enough - 1, enough)]
    assert [reason is None for reason in reasons] == [False, True]


def test_neighbouring_matches_count_once() -> None:
    points = np.repeat(_apart(MIN_PLACES - 1), 50, axis=0)
    everything = np.ones(len(points), dtype=np.bool_)
    assert (
        rejection_reason(points, points, everything, SIZE, 3.0)
        == "350 of 350 matches agree, but they lie in 7 places of the image only"
    )
    one_more = np.vstack([points, _apart(MIN_PLACES)[-1:]])
    assert rejection_reason(one_more, one_more, np.ones(len(one_more), dtype=np.bool_), SIZE, 3.0) is None


def test_places_are_those_of_the_image_with_fewer() -> None:
    assert places(_apart(30), _apart(30), SIZE) == 30
    assert places(_apart(30), np.full((30, 2), 7.0), SIZE) == 1
    assert places(_apart(30)[:0], _apart(30)[:0], SIZE) == 0


@pytest.mark.parametrize(
    ("least", "trials", "probability"), [(0, 5, 0.3), (3, 3, 0.2), (40, 4000, 0.011), (2500, 4000, 0.6)]
)
def test_the_tail_is_that_of_the_binomial_distribution(least: int, trials: int, probability: float) -> None:
    assert binomial_tail(least, trials, probability) == pytest.approx(
        binom.sf(least - 1, trials, probability), rel=1e-9
    )
