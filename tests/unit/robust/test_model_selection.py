"""Losses, fits by Levenberg and Marquardt, priors, and which of the fitted models is chosen."""

import math
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import pytest

from rdstitch.alignment.noise import evidence_of
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.numerics.robust_loss import (
    PAIR_WIDTH,
    loss_ratio,
    loss_width,
    noise_of,
    robust_cost,
    robust_weight,
    sigma_of,
)
from rdstitch.robust.levenberg_marquardt import damped_step, damping_by_gain
from rdstitch.robust.model_selection import rms_of
from rdstitch.robust.posterior import Evidence
from rdstitch.robust.priors import LENS_PRIORS, TILT_PRIOR, Prior, exact, focal_prior, prior_costs
from rdstitch.robust.refinement import PairEquations, descend
from rdstitch.robust.similarity_fit import fit_similarity
from tests.alignment_stubs import SCALE, independent_errors, observations

SQUARED = np.array([0.0, 1.0, 4.0, 36.0, np.inf])


def cost(prior: Prior, value: float) -> float:
    return float(prior_costs((prior,), np.array([value]))[0])


def test_the_loss_grows_like_the_square_and_saturates_at_that_of_the_width() -> None:
    """Geman and McClure: ``e² w² / (w² + e²)``."""
    np.testing.assert_allclose(robust_cost(SQUARED, 2.0), [0.0, 0.8, 2.0, 3.6, 4.0])
    np.testing.assert_allclose(robust_cost(SQUARED, 3.0), [0.0, 0.9, 36.0 / 13.0, 7.2, 9.0])
    np.testing.assert_allclose(loss_ratio(SQUARED, 2.0), [1.0, 0.8, 0.5, 0.1, 0.0])


def test_the_weight_is_the_derivative_of_the_loss() -> None:
    squared = SQUARED[:4]
    slope = (robust_cost(squared + 1e-6, 2.0) - robust_cost(squared, 2.0)) / 1e-6
    np.testing.assert_allclose(robust_weight(squared, 2.0), slope, rtol=1e-5)
    assert robust_weight(SQUARED, 2.0)[-1] == 0.0


def test_the_noise_is_that_of_the_median_below_the_threshold() -> None:
    rng = np.random.default_rng(0)
    lengths = np.hypot(*rng.normal(0.0, 0.7, (2, 5, 4001)))
    np.testing.assert_allclose(noise_of(lengths, 100.0), 0.7, rtol=0.03)
    known = np.array(
        [[1.0, 2.0, 3.0, 50.0, np.inf], [1.0, 2.0, 3.0, 4.0, 50.0], [50.0] * 5, [1.0, 2.0, 50.0, 50.0, 50.0]]
    )
    np.testing.assert_allclose(noise_of(known, 10.0), [2.0 / 1.1774, 2.5 / 1.1774, 0.02, 1.5 / 1.1774])
    np.testing.assert_allclose(noise_of(np.full((1, 9), 1e-3), 10.0), 0.02)
    np.testing.assert_allclose(noise_of(np.array([[2.0, 10.0]]), 10.0), 2.0 / 1.1774)  # at the threshold is outside
    np.testing.assert_allclose(noise_of(np.array([[1.0, 2.0, 4.0]]), 10.0), 2.0 / 1.1774)
    # Six numbers to which two parameters were fitted have four degrees of freedom.
    np.testing.assert_allclose(noise_of(np.array([[1.0, 2.0, 4.0]]), 10.0, 2), np.sqrt(6 / 4) * 2.0 / 1.1774)
    assert sigma_of(np.empty(0)) == np.inf


def test_the_loss_is_no_wider_than_the_threshold() -> None:
    np.testing.assert_allclose(loss_width(np.array([0.1, 0.5, 0.9]), 3.0), [0.1 * PAIR_WIDTH, 0.5 * PAIR_WIDTH, 3.0])


def test_the_rms_is_that_of_the_inliers() -> None:
    errors = np.array([[3.0, 4.0, 20.0], [20.0, 30.0, np.inf], [1.0, 9.9, 10.0]])
    found = rms_of(errors, 10.0)
    np.testing.assert_allclose(found[[0, 2]], [np.sqrt(12.5), np.sqrt((1.0 + 9.9**2) / 2)])
    assert np.isnan(found[1])


@dataclass(frozen=True)
class _Valleys:
    """Losses ``floor + (x² - 1)²`` of one parameter with noise of 0.01, and how often each was evaluated."""

    floor: FloatArray
    number: IntArray
    evaluations: IntArray

    def take(self, rows: BoolArray | IntArray) -> "_Valleys":
        return _Valleys(self.floor[rows], self.number[rows], self.evaluations)

    def normal_equations(self, parameters: FloatArray) -> PairEquations:
        self.evaluations[self.number] += 1
        x = parameters[:, 0]
        residual, slope = x**2 - 1.0, 2.0 * x
        cost, information, gradient = self.floor + residual**2, (slope**2)[:, None, None], (slope * residual)[:, None]
        none, noise = np.zeros(len(x)), np.full(len(x), 0.01)
        return PairEquations(cost, information, gradient, (residual**2)[:, None], none, noise, none, cast(Any, none))

    def cost(self, before: PairEquations, after: PairEquations) -> FloatArray:
        return before.cost

    def retract(self, parameters: FloatArray, step: FloatArray) -> tuple[FloatArray, BoolArray]:
        return parameters + step, np.ones(len(step), dtype=np.bool_)


def test_descents_in_lockstep_do_not_notice_each_other() -> None:
    """One that starts farther off goes on when the other has converged."""
    counted = np.zeros(2, dtype=np.intp)
    start = np.array([[1.5], [30.0]])
    found, equations = descend(cast(Any, _Valleys(np.zeros(2), np.arange(2), counted)), start, 30)
    np.testing.assert_allclose(found, 1.0, atol=1e-2)
    alone, _ = descend(cast(Any, _Valleys(np.zeros(1), np.arange(1), np.zeros(1, dtype=np.intp))), start[:1], 30)
    assert found[0, 0] == alone[0, 0]
    np.testing.assert_array_equal(equations.squared, (found**2 - 1.0) ** 2)
    assert counted[0] < counted[1]


def test_what_is_only_a_start_takes_fewer_steps() -> None:
    valley: Any = _Valleys(np.ones(1), np.arange(1), np.zeros(1, dtype=np.intp))
    start = np.full((1, 1), 1.003)
    assert descend(valley, start, 30, loose=True)[0] == start
    assert abs(descend(valley, start, 30)[0] - 1.0) < 1e-3


def test_damping_follows_what_steps_gain() -> None:
    for gain, factor in ((1.0, 1.0 / 3.0), (1.7, 1.0 / 3.0), (0.5, 1.0)):
        assert damping_by_gain(3e-4, 2, gain) == (3e-4 * factor, 0)
    assert damping_by_gain(3e-4, 0, 0.01)[0] > 5e-4
    damping, failures = 1e-4, 0
    for factor in (2.0, 8.0, 64.0):
        damping, failures = damping_by_gain(damping, failures, -np.inf)
        assert damping == pytest.approx(1e-4 * factor)
    assert damping_by_gain(damping, failures, 0.5) == (damping, 0)


FACTOR, ORIGIN = 0.03 * np.exp(0.8j), 4e5 + 5e6j


@pytest.mark.parametrize("count", [4, 5, 8, 200])
@pytest.mark.parametrize("far", [300.0, 5e6])
def test_what_is_wrong_does_not_count_and_is_named(count: int, far: float) -> None:
    rng = np.random.default_rng(count)
    source = np.asarray(4000.0 * (rng.random(count) + 1j * rng.random(count)), dtype=np.complex128)
    target = FACTOR * source + ORIGIN + 0.5 * (rng.normal(size=count) + 1j * rng.normal(size=count))
    wrong = rng.permutation(count)[: (count - 2) // 2]
    target[wrong] += far * np.exp(1j * rng.uniform(0, 2 * np.pi, len(wrong)))
    fit = fit_similarity(source, target, 3.0)
    assert np.flatnonzero(~fit.inliers).tolist() == sorted(wrong)
    middle = 2000.0 + 2000.0j
    assert abs(fit.scale * middle + fit.origin - FACTOR * middle - ORIGIN) < 3.0
    assert abs(fit.scale / FACTOR - 1) < 0.05


def test_points_that_are_all_the_same_place_targets_in_their_middle() -> None:
    fit = fit_similarity(np.ones(4, np.complex128), np.arange(4, dtype=np.complex128), 1.0)
    assert fit.scale + fit.origin == pytest.approx(1.5, abs=1e-3)


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
    return float((evidence.cost(errors, 0) - evidence.cost(errors / 1.5, 0))[0])


def test_shared_errors_count_alike_however_many_matches_there_are() -> None:
    few, many = _gain(60), _gain(600)
    assert few > 0.0
    assert many < 2.5 * few  # of ten times as many matches


def test_noise_counts_match_by_match_and_a_field_cell_by_cell() -> None:
    each, links = 300, 5
    noise = independent_errors(links, each, 0.5).reshape(-1, 2)
    evidence = evidence_of(observations(noise.reshape(links, each, 2)), noise)
    field = _shared(links, each, 5.0).reshape(-1, 2)
    as_noise, as_field = (math.exp((evidence.cost(one, 1) - evidence.cost(one, 0))[0]) for one in (noise, field))
    assert as_noise > 0.5 * 2.0 * links * each
    assert as_field < 2.5 * 16 * links
    assert evidence.field(field)[0] == pytest.approx(5.0, rel=0.5)
    assert evidence.field(noise) < 0.3
    assert evidence.cost(noise, 0) < evidence.cost(field, 0)


def test_next_to_the_same_errors_cost_next_to_the_same() -> None:
    errors = (_shared(5, 300, 1.0) + independent_errors(5, 300, 1.0)).reshape(-1, 2)
    evidence = evidence_of(observations(errors.reshape(5, 300, 2)), independent_errors(5, 300, 1.0).reshape(-1, 2))
    costs = [evidence.cost(errors * size, 60)[0] for size in np.geomspace(0.5, 4.0, 400)]
    assert np.abs(np.diff(costs)).max() < 5.0


def test_links_between_few_images_measure_the_same_again() -> None:
    errors = independent_errors(links=9)  # between six images, which five links would join
    assert evidence_of(observations(errors), errors.reshape(-1, 2)).weight == [pytest.approx(5 / 9)]


def test_what_cannot_be_transferred_counts_as_a_large_error() -> None:
    errors = independent_errors().reshape(-1, 2)
    evidence = evidence_of(observations(errors.reshape(9, 60, 2)), errors)
    lost, far = errors.copy(), errors.copy()
    lost[::7], far[::7] = np.nan, 30.0 * SCALE
    assert evidence.cost(errors, 0) < evidence.cost(lost, 0) < np.inf
    assert evidence.cost(far, 0) < np.inf


def test_problems_that_are_compared_together_do_not_notice_each_other() -> None:
    rng = np.random.default_rng(5)
    link, points = np.repeat([0, 1, 2], 80), rng.uniform(-0.6, 0.6, (240, 2))
    errors = rng.normal(0.0, 1.0, (240, 2)) * np.repeat([0.3, 2.0, 6.0], 80)[:, None]
    noise, scale = np.array([0.3, 0.5, 0.2]), np.array([400.0, 500.0, 600.0])
    together = Evidence.of(link, points, np.arange(3), noise, scale)
    for k in range(3):
        own = link == k
        alone = Evidence.of(link[own] * 0, points[own], np.zeros(1, dtype=np.intp), noise[[k]], scale[[k]])
        assert alone.cost(errors[own], 3)[0] == pytest.approx(together.cost(errors, 3)[k])
        assert alone.field(errors[own])[0] == pytest.approx(together.field(errors)[k])


EXIF = focal_prior(math.log(1.2), 0.05, "exif")


@pytest.mark.parametrize(
    "prior", [*LENS_PRIORS[:2], TILT_PRIOR, EXIF, exact(0.3)], ids=["λ", "μ", "tilt", "exif", "exact"]
)
@pytest.mark.parametrize("value", [-0.7, -0.05, 0.0, 0.2, 1.1])
def test_the_slope_is_half_the_derivative_of_the_cost(prior: Prior, value: float) -> None:
    step = 1e-7
    numeric = (cost(prior, value + step) - cost(prior, value - step)) / (2.0 * step)
    assert 2.0 * prior.slope(value) == pytest.approx(numeric, rel=1e-3, abs=1e-4)
    assert prior.curvature(value) > 0.0


def test_images_overrule_what_is_sometimes_wrong_but_not_what_was_given() -> None:
    ten_times = math.log(12.0)
    assert cost(EXIF, math.log(1.2)) == pytest.approx(0.0, abs=0.2)
    assert cost(EXIF, math.log(1.3)) == pytest.approx((math.log(1.3 / 1.2) / 0.05) ** 2, rel=0.1)
    assert cost(EXIF, ten_times) < 40.0
    assert cost(focal_prior(math.log(1.2), 0.01, "option"), ten_times) > 10_000.0


def test_fisheyes_are_possible_and_strong_pincushion_is_not() -> None:
    assert cost(LENS_PRIORS[0], -0.35) < 10.0
    assert cost(LENS_PRIORS[0], 0.2) > 20.0
    assert cost(LENS_PRIORS[0], -0.02) < 1.0


@pytest.mark.parametrize(("value", "std", "found"), [(-0.3, 0.001, -0.3), (0.08, 0.04, 0.04), (-0.3, 0.12, -0.325)])
def test_a_measurement_and_a_prior_meet_by_their_variances(value: float, std: float, found: float) -> None:
    assert LENS_PRIORS[0].combined(value, std) == pytest.approx(found, abs=1e-4)


def test_a_measurement_stands_without_a_prior_or_where_it_is_exact() -> None:
    assert Prior().combined(0.3, 1.0) == 0.3
    assert LENS_PRIORS[0].combined(0.3, 0.0) == 0.3


@pytest.mark.parametrize("std", [0.01, 0.03, 0.08])
@pytest.mark.parametrize("value", [-0.14, -0.125, -0.12])
def test_near_the_crossing_of_two_parts_they_meet_where_both_together_put_them(value: float, std: float) -> None:
    found = LENS_PRIORS[0].combined(value, std)
    assert LENS_PRIORS[0].slope(found) + (found - value) / std**2 == pytest.approx(0.0, abs=1e-6)


def test_a_singular_problem_leaves_the_others_as_if_they_were_alone() -> None:
    damping = np.full(2, 1e-4)
    singular = 1.0 + (damping[0] + 1e-12)
    information = np.array([[[2.0, 1.0], [1.0, 3.0]], [[1.0, singular], [singular, 1.0]]])
    gradient = np.array([[0.3, -0.7], [1.0, 1.0]])
    together, alone = (damped_step(information[:k], gradient[:k], damping[:k]) for k in (2, 1))
    assert together[0].tobytes() == alone[0].tobytes()
    assert np.isnan(together[1]).all()
