"""What hypotheses are compared by: errors count in independent pieces of the scene, priors as densities."""

import math

import numpy as np
import pytest

from rdstitch.alignment.noise import evidence_of
from rdstitch.arrays import FloatArray
from rdstitch.robust.posterior import LENS, TILT, Evidence, Prior, exact, focal_prior
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
    evidence = evidence_of(observations(errors.reshape(5, each, 2)), independent_errors(5, each, 0.2).reshape(-1, 2))
    return float((evidence.cost(errors).cost - evidence.cost(errors / 1.5).cost)[0])


def test_shared_errors_count_alike_however_many_matches_there_are() -> None:
    few, many = _gain(60), _gain(600)
    assert few > 0.0
    assert many < 2.5 * few  # of ten times as many matches


def test_noise_counts_match_by_match_and_a_field_cell_by_cell() -> None:
    each, links = 300, 5
    noise = independent_errors(links, each, 0.5).reshape(-1, 2)
    evidence = evidence_of(observations(noise.reshape(links, each, 2)), noise)
    as_noise = evidence.cost(noise)
    as_field = evidence.cost(_shared(links, each, 5.0).reshape(-1, 2))
    assert as_noise.count > 0.5 * 2.0 * links * each
    assert as_field.count < 2.5 * 16 * links
    assert as_field.field[0] == pytest.approx(5.0, rel=0.5)
    assert as_noise.field < 0.3
    assert as_noise.cost < as_field.cost


def test_links_between_few_images_measure_the_same_again() -> None:
    errors = independent_errors(links=9)  # between six images, which five links would join
    assert evidence_of(observations(errors), errors.reshape(-1, 2)).weight == [pytest.approx(5 / 9)]


def test_what_cannot_be_transferred_counts_as_a_large_error() -> None:
    errors = independent_errors().reshape(-1, 2)
    evidence = evidence_of(observations(errors.reshape(9, 60, 2)), errors)
    lost, far = errors.copy(), errors.copy()
    lost[::7], far[::7] = np.nan, 30.0 * SCALE
    assert evidence.cost(errors).cost < evidence.cost(lost).cost < np.inf
    assert evidence.cost(far).cost < np.inf


def test_problems_that_are_compared_together_do_not_notice_each_other() -> None:
    rng = np.random.default_rng(5)
    link, points = np.repeat([0, 1, 2], 80), rng.uniform(-0.6, 0.6, (240, 2))
    errors = rng.normal(0.0, 1.0, (240, 2)) * np.repeat([0.3, 2.0, 6.0], 80)[:, None]
    noise, scale = np.array([0.3, 0.5, 0.2]), np.array([400.0, 500.0, 600.0])
    together = Evidence.of(link, points, np.arange(3), noise, scale).cost(errors)
    for k in range(3):
        own = link == k
        alone = Evidence.of(link[own] * 0, points[own], np.zeros(1, dtype=np.intp), noise[[k]], scale[[k]])
        found = alone.cost(errors[own])
        for name in ("cost", "field", "count"):
            assert getattr(found, name)[0] == pytest.approx(getattr(together, name)[k])


EXIF = focal_prior(math.log(1.2), 0.05, "exif")


@pytest.mark.parametrize("prior", [LENS[0], LENS[1], TILT, EXIF, exact(0.3)], ids=["λ", "μ", "tilt", "exif", "exact"])
@pytest.mark.parametrize("value", [-0.7, -0.05, 0.0, 0.2, 1.1])
def test_the_slope_is_half_the_derivative_of_the_cost(prior: Prior, value: float) -> None:
    step = 1e-7
    numeric = (prior.cost(value + step) - prior.cost(value - step)) / (2.0 * step)
    assert 2.0 * prior.slope(value) == pytest.approx(numeric, rel=1e-3, abs=1e-4)
    assert prior.curvature(value) > 0.0


def test_no_prior_says_nothing() -> None:
    assert (Prior().cost(5.0), Prior().slope(5.0), Prior().curvature(5.0)) == (0.0, 0.0, 0.0)


def test_images_overrule_what_is_sometimes_wrong_but_not_what_was_given() -> None:
    ten_times = math.log(12.0)
    assert EXIF.cost(math.log(1.2)) == pytest.approx(0.0, abs=0.2)
    assert EXIF.cost(math.log(1.3)) == pytest.approx((math.log(1.3 / 1.2) / 0.05) ** 2, rel=0.1)
    assert EXIF.cost(ten_times) < 40.0
    assert focal_prior(math.log(1.2), 0.01, "option").cost(ten_times) > 10_000.0


def test_fisheyes_are_possible_and_strong_pincushion_is_not() -> None:
    assert LENS[0].cost(-0.35) < 10.0
    assert LENS[0].cost(0.2) > 20.0
    assert LENS[0].cost(-0.02) < 1.0


@pytest.mark.parametrize(("value", "std", "found"), [(-0.3, 0.001, -0.3), (0.08, 0.04, 0.04), (-0.3, 0.12, -0.325)])
def test_a_measurement_and_a_prior_meet_by_their_variances(value: float, std: float, found: float) -> None:
    assert LENS[0].combined(value, std) == pytest.approx(found, abs=1e-4)


@pytest.mark.parametrize("std", [0.01, 0.03, 0.08])
@pytest.mark.parametrize("value", [-0.14, -0.125, -0.12])
def test_near_the_crossing_of_two_parts_they_meet_where_both_together_put_them(value: float, std: float) -> None:
    found = LENS[0].combined(value, std)
    assert LENS[0].slope(found) + (found - value) / std**2 == pytest.approx(0.0, abs=1e-6)
