"""Minimal samples: distinct, deterministic, the promising first, all in the end."""

import numpy as np
import pytest

from rdstitch.arrays import IntArray
from rdstitch.robust.sampling import Sampler


def _draw(sampler: Sampler, count: int, batch: int, *, start: int = 0, ordered: bool = False) -> IntArray:
    picks: IntArray = sampler.draw(np.array([start]), batch, np.array([count]), np.array([ordered]))[0]
    return picks


@pytest.mark.parametrize("ordered", [False, True])
def test_samples_are_distinct_and_in_range(ordered: bool) -> None:
    picks = _draw(Sampler(5, 1000, 3), 40, 2000, ordered=ordered)
    assert picks.min() == 0
    assert picks.max() == 39
    assert (np.diff(np.sort(picks, axis=1), axis=1) > 0).all()


def test_uniform_samples_use_every_match_equally() -> None:
    picks = _draw(Sampler(4, 1000, 0), 20, 20000)
    shares = np.bincount(picks.ravel(), minlength=20) / picks.size
    np.testing.assert_allclose(shares, 0.05, rtol=0.06)


def test_the_best_come_first_and_all_come_in_the_end() -> None:
    sampler = Sampler(3, 4000, 1)
    first = _draw(sampler, 100, 32, ordered=True)[::2]
    assert (first < 20).mean() > 0.9
    last = _draw(sampler, 100, 400, start=8000, ordered=True)[::2]
    assert (last < 20).mean() < 0.3


def test_every_other_sample_is_uniform_whatever_the_order() -> None:
    picks = _draw(Sampler(3, 4000, 1), 100, 400, ordered=True)[1::2]
    assert 0.1 < (picks < 20).mean() < 0.3


def test_same_seed_same_samples_whatever_the_batches_and_the_other_pairs() -> None:
    together = Sampler(3, 1000, 7).draw(np.zeros(2, dtype=np.intp), 64, np.array([50, 80]), np.array([True, False]))
    sampler = Sampler(3, 1000, 7)
    parts = [_draw(sampler, 50, 32, start=start, ordered=True) for start in (0, 32)]
    assert np.array_equal(together[0], np.concatenate(parts))
    assert np.array_equal(together[1], _draw(Sampler(3, 1000, 7), 80, 64))
    assert not np.array_equal(together[1], _draw(Sampler(3, 1000, 8), 80, 64))


def test_as_many_matches_as_a_sample_needs() -> None:
    picks = _draw(Sampler(3, 10, 0), 3, 4, ordered=True)
    assert np.array_equal(np.sort(picks, axis=1), np.tile([0, 1, 2], (4, 1)))
