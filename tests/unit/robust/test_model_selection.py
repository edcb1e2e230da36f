"""What the models of a pair are compared by: the noise, the width of the loss, and the price of freedom."""

import numpy as np
import pytest

from rdstitch.robust.loss import PAIR_WIDTH
from rdstitch.robust.model_selection import loss_width, noise_of, rms_of


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
