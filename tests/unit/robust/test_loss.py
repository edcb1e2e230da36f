"""The robust loss, its weight, and what its width does."""

import numpy as np
import pytest

from rdstitch.robust.loss import RAYLEIGH_MEDIAN, loss_ratio, robust_cost, robust_weight

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
