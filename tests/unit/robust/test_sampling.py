"""Minimal samples: distinct, deterministic, the promising first, all in the end."""

import numpy as np
import pytest

from rdstitch.robust.sampling import Sampler


@pytest.mark.parametrize("quality", [None, np.linspace(1.0, 0.0, 40)])
def test_samples_are_distinct_and_in_range(quality: np.ndarray | None) -> None:
    picks = Sampler(40, 5, quality, 1000, 3).draw(2000)
    assert picks.min() == 0
    assert picks.max() == 39
    ordered = np.sort(picks, axis=1)
    assert (np.diff(ordered, axis=1) > 0).all()


def test_uniform_samples_use_every_correspondence_equally() -> None:
    picks = Sampler(20, 4, None, 1000, 0).draw(20000)
    shares = np.bincount(picks.ravel(), minlength=20) / picks.size
    np.testing.assert_allclose(shares, 0.05, rtol=0.06)


def test_the_best_come_first_and_all_come_in_the_end() -> None:
    quality = np.random.default_rng(0).permutation(100).astype(float)
    best = np.argsort(-quality)[:20]
    sampler = Sampler(100, 3, quality, 4000, 1)
    first = sampler.draw(32)[::2]
    assert np.isin(first, best).mean() > 0.95
    for _ in range(20):
        last = sampler.draw(400)[::2]
    assert np.isin(last, best).mean() < 0.3


def test_same_seed_same_samples() -> None:
    one = Sampler(50, 3, None, 1000, 7).draw(64)
    assert np.array_equal(one, Sampler(50, 3, None, 1000, 7).draw(64))
    assert not np.array_equal(one, Sampler(50, 3, None, 1000, 8).draw(64))


def test_as_many_correspondences_as_a_sample_needs() -> None:
    assert np.array_equal(np.sort(Sampler(3, 3, np.ones(3), 10, 0).draw(4), axis=1), np.tile([0, 1, 2], (4, 1)))
