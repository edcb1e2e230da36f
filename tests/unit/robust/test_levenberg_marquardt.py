"""Many descents in lockstep: each goes as if it were alone."""

from dataclasses import dataclass

import numpy as np
import pytest

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.robust.levenberg_marquardt import BatchedNormalEquations, damping_by_gain, descend


@dataclass(frozen=True)
class _Valleys:
    """Losses ``floor + (x² - 1)²`` of one parameter, and how often each was evaluated."""

    floor: FloatArray
    number: IntArray
    evaluations: IntArray

    def take(self, rows: BoolArray | IntArray) -> "_Valleys":
        return _Valleys(self.floor[rows], self.number[rows], self.evaluations)

    def normal_equations(self, parameters: FloatArray) -> BatchedNormalEquations:
        self.evaluations[self.number] += 1
        x = parameters[:, 0]
        residual, slope = x**2 - 1.0, 2.0 * x
        cost, information, gradient = self.floor + residual**2, (slope**2)[:, None, None], (slope * residual)[:, None]
        return BatchedNormalEquations(cost, information, gradient, (residual**2)[:, None])

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
    start = np.full((1, 1), 1.01)
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
