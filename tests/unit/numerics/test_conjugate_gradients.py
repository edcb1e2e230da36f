"""Conjugate gradients reach the solution, whatever the start and the number of threads."""

import numpy as np
from scipy import sparse

from rdstitch.numerics.conjugate_gradients import conjugate_gradients


def test_conjugate_gradients_reach_zero_from_a_start_that_is_not() -> None:
    matrix = np.array([[5.0, -1.0], [-1.0, 5.0]])
    right = np.array([[0.0, 4.0], [0.0, 4.0]])
    with np.errstate(all="raise", under="ignore"):
        found = conjugate_gradients(matrix, right, np.array([[3.0, 3.0], [-3.0, 1.0]]), lambda left: left / 5.0, 1e-9)
    np.testing.assert_allclose(found, [[0.0, 1.0], [0.0, 1.0]], atol=1e-8)


def test_conjugate_gradients_are_the_same_by_any_number_of_threads() -> None:
    count = 60_000
    matrix = sparse.csr_array(sparse.diags_array([2.001, -1.0, -1.0, 0.0], offsets=[0, 1, -1, 7], shape=(count,) * 2))
    right = np.random.default_rng(0).normal(size=(count, 3))
    found = [conjugate_gradients(matrix, right, 0.0 * right, lambda left: left, 1e-6, workers) for workers in (1, 3)]
    np.testing.assert_array_equal(found[0], found[1])
    assert np.abs(matrix @ found[0] - right).max() < 1e-3


def test_conjugate_gradients_stop_where_a_matrix_is_not_positive() -> None:
    right = np.ones((2, 1))
    found = conjugate_gradients(np.diag([1.0, -1.0]), right, np.zeros((2, 1)), lambda left: left, 1e-9)
    assert np.isfinite(found).all()
