"""Errors count in independent pieces of the scene, not in matches."""

import numpy as np
import pytest

from rdstitch.alignment.residual_likelihood import Evidence
from rdstitch.arrays import FloatArray
from tests.alignment_stubs import SCALE, independent_errors, observations


def _shared(links: int, each: int, size: float, seed: int = 1) -> FloatArray:
    """Errors (L, K, 2) that differ by quarters of the field of view, with a little noise."""
    rng = np.random.default_rng(seed)
    seen = observations(np.zeros((links, each, 2)))
    quarter = (seen.points1 > 0.0) @ np.array([1, 2]) + 4 * seen.link
    field = rng.normal(0.0, size, (4 * links, 2))
    errors: FloatArray = field[quarter] + rng.normal(0.0, 0.2, (links * each, 2))
    return errors.reshape(links, each, 2)


def _gain(each: int) -> float:
    """What errors that neighbours share gain by being a third smaller."""
    errors = _shared(5, each, 3.0).reshape(-1, 2)
    evidence = Evidence.of(observations(errors.reshape(5, each, 2)), independent_errors(5, each, 0.2).reshape(-1, 2))
    return evidence.cost(errors).cost - evidence.cost(errors / 1.5).cost


def test_shared_errors_count_alike_however_many_matches_there_are() -> None:
    few, many = _gain(60), _gain(600)
    assert few > 0.0
    assert many < 2.5 * few  # of ten times as many matches


def test_noise_counts_match_by_match_and_a_field_cell_by_cell() -> None:
    each, links = 300, 5
    noise = independent_errors(links, each, 0.5).reshape(-1, 2)
    evidence = Evidence.of(observations(noise.reshape(links, each, 2)), noise)
    as_noise = evidence.cost(noise)
    as_field = evidence.cost(_shared(links, each, 5.0).reshape(-1, 2))
    assert as_noise.count > 0.5 * 2.0 * links * each
    assert as_field.count < 2.5 * 16 * links
    assert as_field.field == pytest.approx(5.0, rel=0.5)
    assert as_noise.field < 0.3
    assert as_noise.cost < as_field.cost


def test_links_between_few_images_measure_the_same_again() -> None:
    errors = independent_errors(links=9)  # between six images, which five links would join
    assert Evidence.of(observations(errors), errors.reshape(-1, 2)).weight == pytest.approx(5 / 9)


def test_what_cannot_be_transferred_counts_as_a_large_error() -> None:
    errors = independent_errors().reshape(-1, 2)
    evidence = Evidence.of(observations(errors.reshape(9, 60, 2)), errors)
    lost, far = errors.copy(), errors.copy()
    lost[::7], far[::7] = np.nan, 30.0 * SCALE
    assert evidence.cost(errors).cost < evidence.cost(lost).cost < np.inf
    assert evidence.cost(far).cost < np.inf
