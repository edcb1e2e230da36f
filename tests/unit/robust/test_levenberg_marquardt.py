"""Levenberg-Marquardt in lockstep, on problems with known minima."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import pytest

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.robust.levenberg_marquardt import (
    FIRST_DAMPING,
    LARGEST_DAMPING,
    BatchedNormalEquations,
    descend,
    next_damping,
)


@dataclass(frozen=True)
class Valleys:
    """Rosenbrock's curved valleys ``(a - x)² + b (y - x²)²`` as least squares; minima at (a, a²), cost ``offset``."""

    a: FloatArray
    b: FloatArray
    offset: FloatArray

    def take(self, rows: BoolArray | IntArray) -> Self:
        """Some of them."""
        return type(self)(self.a[rows], self.b[rows], self.offset[rows])

    def normal_equations(self, parameters: FloatArray) -> BatchedNormalEquations:
        """Residuals ``a - x`` and ``√b (y - x²)``."""
        x, y = parameters.T
        root, zero = np.sqrt(self.b), np.zeros_like(x)
        residual = np.stack([self.a - x, root * (y - x**2)], axis=1)
        jacobian = np.stack([np.stack([zero - 1.0, zero], 1), np.stack([-2.0 * root * x, root], 1)], axis=1)
        cost = (residual**2).sum(axis=1) + self.offset
        gradient = np.einsum("bip,bi->bp", jacobian, residual)
        return BatchedNormalEquations(cost, np.swapaxes(jacobian, 1, 2) @ jacobian, gradient)


def _add(parameters: FloatArray, step: FloatArray) -> tuple[FloatArray, BoolArray]:
    moved = parameters + step
    return moved, np.asarray(np.isfinite(moved).all(axis=1))


VALLEYS = Valleys(np.array([1.0, 2.0, -1.5]), np.array([100.0, 10.0, 1.0]), np.array([1e-9, 1e-9, 1e-9]))
START = np.array([[-1.2, 1.0], [0.0, 0.0], [3.0, -1.0]])
MINIMA = np.stack([VALLEYS.a, VALLEYS.a**2], axis=1)


def test_each_problem_comes_to_its_minimum_as_if_alone() -> None:
    together = descend(VALLEYS, _add, START, 100)
    np.testing.assert_allclose(together, MINIMA, atol=1e-4)
    for row in range(3):
        only = np.array([row])
        np.testing.assert_array_equal(descend(VALLEYS.take(only), _add, START[only], 100)[0], together[row])


def test_no_step_without_iterations_and_none_uphill() -> None:
    np.testing.assert_array_equal(descend(VALLEYS, _add, START, 0), START)
    costs = [VALLEYS.normal_equations(descend(VALLEYS, _add, START, count)).cost for count in range(8)]
    assert (np.diff(costs, axis=0) <= 0.0).all()
    assert (costs[0] > 100.0 * costs[-1]).any()


def test_impossible_steps_are_not_taken() -> None:
    def fenced(parameters: FloatArray, step: FloatArray) -> tuple[FloatArray, BoolArray]:
        moved = parameters + step
        return moved, (moved[:, 0] < 0.5) & np.isfinite(moved).all(axis=1)

    found = descend(VALLEYS, fenced, np.array([[0.2, 0.0], [0.0, 0.0], [-1.0, 0.0]]), 60)
    assert (found[:, 0] < 0.5).all()
    np.testing.assert_allclose(found[2], MINIMA[2], atol=1e-4)


def test_a_gain_of_a_hundredth_of_the_noise_ends_it() -> None:
    """Expected falls of the cost below 1e-5 of it are not worth a step."""
    near = MINIMA + np.array([1.0, 0.0]) * 1e-3 / np.sqrt(1.0 + 4.0 * VALLEYS.b[:, None] * VALLEYS.a[:, None] ** 2)
    falls = VALLEYS.normal_equations(near).cost - VALLEYS.offset
    for share, moves in ((0.9e-5, False), (1.2e-5, True)):
        found = descend(Valleys(VALLEYS.a, VALLEYS.b, falls / share), _add, near, 1)
        assert ((found == near).all(axis=1) == (not moves)).all(), share


def test_what_nothing_determines_stays_where_it_is() -> None:
    """A problem of zeros beside others, and one whose second parameter has no influence."""
    flat = Valleys(np.array([0.0, 1.0]), np.array([0.0, 0.0]), np.array([1e-9, 1e-9]))
    found = descend(flat, _add, np.array([[0.0, 5.0], [0.0, 5.0]]), 20)
    np.testing.assert_allclose(found, [[0.0, 5.0], [1.0, 5.0]], atol=1e-4)


def test_damping_falls_tenfold_after_a_good_step_and_rises_twentyfold_after_a_bad_one() -> None:
    damping = np.array([FIRST_DAMPING, FIRST_DAMPING, 1e-9])
    np.testing.assert_allclose(next_damping(damping, np.array([True, False, True])), [1e-5, 2e-3, 1e-9])
    assert pytest.approx(1e4) == LARGEST_DAMPING


def test_damping_enlarges_the_diagonal() -> None:
    """The first step is ``-(A + d diag A)⁻¹ g``, d the first damping (Marquardt)."""
    start = MINIMA + 0.01
    equations = VALLEYS.normal_equations(start)
    diagonal = np.einsum("bpp->bp", equations.information)
    damped = equations.information + FIRST_DAMPING * diagonal[:, :, None] * np.eye(2)
    step = -np.linalg.solve(damped, equations.gradient[:, :, None])[:, :, 0]
    np.testing.assert_allclose(descend(VALLEYS, _add, start, 1) - start, step, rtol=1e-6)
