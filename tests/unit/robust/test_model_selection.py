"""Losses, fits by Levenberg and Marquardt, and which of the fitted models is chosen."""

from dataclasses import dataclass

import numpy as np
import pytest

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.robust.levenberg_marquardt import BatchedNormalEquations, damping_by_gain, descend
from rdstitch.robust.loss import (
    PAIR_WIDTH,
    RAYLEIGH_MEDIAN,
    loss_ratio,
    loss_width,
    noise_of,
    robust_cost,
    robust_weight,
)
from rdstitch.robust.model_selection import rms_of
from rdstitch.robust.similarity_fit import fit_similarity

SQUARED = np.array([0.0, 1.0, 4.0, 36.0, np.inf])


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


def test_half_of_all_normal_vectors_are_shorter_than_the_median() -> None:
    assert pytest.approx(0.5, abs=1e-4) == 1.0 - np.exp(-(RAYLEIGH_MEDIAN**2) / 2.0)


def test_the_noise_is_that_of_the_median_below_the_threshold() -> None:
    rng = np.random.default_rng(0)
    lengths = np.hypot(*rng.normal(0.0, 0.7, (2, 5, 4001)))
    np.testing.assert_allclose(noise_of(lengths, 100.0), 0.7, rtol=0.03)
    known = np.array(
        [[1.0, 2.0, 3.0, 50.0, np.inf], [1.0, 2.0, 3.0, 4.0, 50.0], [50.0] * 5, [1.0, 2.0, 50.0, 50.0, 50.0]]
    )
    np.testing.assert_allclose(noise_of(known, 10.0), [2.0 / 1.1774, 2.5 / 1.1774, 0.02, 1.5 / 1.1774])
    np.testing.assert_allclose(noise_of(np.full((1, 9), 1e-3), 10.0), 0.02)
    np.testing.assert_allclose(noise_of(np.array([[1.0, 2.0, 4.0]]), 10.0), 2.0 / 1.1774)
    # Six numbers to which two parameters were fitted have four degrees of freedom.
    np.testing.assert_allclose(noise_of(np.array([[1.0, 2.0, 4.0]]), 10.0, 2), np.sqrt(6 / 4) * 2.0 / 1.1774)


def test_the_loss_is_no_wider_than_the_threshold() -> None:
    np.testing.assert_allclose(loss_width(np.array([0.1, 0.5, 0.9]), 3.0), [0.1 * PAIR_WIDTH, 0.5 * PAIR_WIDTH, 3.0])


def test_the_rms_is_that_of_the_inliers() -> None:
    errors = np.array([[3.0, 4.0, 20.0], [20.0, 30.0, np.inf], [1.0, 9.9, 10.0]])
    found = rms_of(errors, 10.0)
    np.testing.assert_allclose(found[[0, 2]], [np.sqrt(12.5), np.sqrt((1.0 + 9.9**2) / 2)])
    assert np.isnan(found[1])


@pytest.mark.parametrize("threshold", [1.0, 10.0])
def test_an_error_at_the_threshold_is_outside(threshold: float) -> None:
    errors = np.array([[0.5 * threshold, threshold]])
    assert rms_of(errors, threshold) == pytest.approx(0.5 * threshold)
    assert noise_of(errors, threshold) == pytest.approx(max(0.5 * threshold / 1.1774, 0.02))


class _ValleyEquations(BatchedNormalEquations):
    """Noise of a hundredth of the loss at the bottom."""

    @property
    def unit(self) -> FloatArray:
        return np.full(len(self.cost), 1e-4)


@dataclass(frozen=True)
class _Valleys:
    """Losses ``floor + (x² - 1)²`` of one parameter, and how often each was evaluated."""

    floor: FloatArray
    number: IntArray
    evaluations: IntArray

    def take(self, rows: BoolArray | IntArray) -> "_Valleys":
        return _Valleys(self.floor[rows], self.number[rows], self.evaluations)

    def normal_equations(self, parameters: FloatArray) -> _ValleyEquations:
        self.evaluations[self.number] += 1
        x = parameters[:, 0]
        residual, slope = x**2 - 1.0, 2.0 * x
        cost, information, gradient = self.floor + residual**2, (slope**2)[:, None, None], (slope * residual)[:, None]
        return _ValleyEquations(cost, information, gradient, (residual**2)[:, None])

    def cost(self, before: _ValleyEquations, after: _ValleyEquations) -> FloatArray:
        return before.cost

    def retract(self, parameters: FloatArray, step: FloatArray) -> tuple[FloatArray, BoolArray]:
        return parameters + step, np.ones(len(step), dtype=np.bool_)


def test_descents_in_lockstep_do_not_notice_each_other() -> None:
    """One that starts farther off goes on when the other has converged."""
    counted = np.zeros(2, dtype=np.intp)
    start = np.array([[1.5], [30.0]])
    found, equations = descend(_Valleys(np.zeros(2), np.arange(2), counted), start, 30)
    np.testing.assert_allclose(found, 1.0, atol=1e-2)
    alone, _ = descend(_Valleys(np.zeros(1), np.arange(1), np.zeros(1, dtype=np.intp)), start[:1], 30)
    assert found[0, 0] == alone[0, 0]
    np.testing.assert_array_equal(equations.squared, (found**2 - 1.0) ** 2)
    assert counted[0] < counted[1]


def test_what_is_only_a_start_takes_fewer_steps() -> None:
    valley = _Valleys(np.ones(1), np.arange(1), np.zeros(1, dtype=np.intp))
    start = np.full((1, 1), 1.003)
    assert descend(valley, start, 30, rough=True)[0] == start
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


SCALE, ORIGIN = 0.03 * np.exp(0.8j), 4e5 + 5e6j


@pytest.mark.parametrize("count", [4, 5, 8, 200])
@pytest.mark.parametrize("far", [300.0, 5e6])
def test_what_is_wrong_does_not_count_and_is_named(count: int, far: float) -> None:
    rng = np.random.default_rng(count)
    source = np.asarray(4000.0 * (rng.random(count) + 1j * rng.random(count)), dtype=np.complex128)
    target = SCALE * source + ORIGIN + 0.5 * (rng.normal(size=count) + 1j * rng.normal(size=count))
    wrong = rng.permutation(count)[: (count - 2) // 2]
    target[wrong] += far * np.exp(1j * rng.uniform(0, 2 * np.pi, len(wrong)))
    fit = fit_similarity(source, target, 3.0)
    assert np.flatnonzero(~fit.inliers).tolist() == sorted(wrong)
    middle = 2000.0 + 2000.0j
    assert abs(fit.scale * middle + fit.origin - SCALE * middle - ORIGIN) < 3.0
    assert abs(fit.scale / SCALE - 1) < 0.05


def test_points_that_are_all_the_same_place_targets_in_their_middle() -> None:
    fit = fit_similarity(np.ones(4, np.complex128), np.arange(4, dtype=np.complex128), 1.0)
    assert fit.scale + fit.origin == pytest.approx(1.5, abs=1e-3)
