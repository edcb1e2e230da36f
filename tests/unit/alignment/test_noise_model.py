"""The noise that models are compared by."""

import math

import numpy as np
import pytest

from rdstitch.alignment.link_equations import squared_lengths
from rdstitch.alignment.noise import EXACTNESS, NoiseModel, noise_of_links
from rdstitch.alignment.observations import Observations
from tests.alignment_stubs import SHIFT, independent_errors, observations


def test_the_noise_is_the_scatter_and_what_no_model_is_exact_to() -> None:
    errors = independent_errors(sigma=0.5)
    seen = observations(errors)
    found = NoiseModel.of_errors(seen, errors.reshape(-1, 2))
    assert found.noise == pytest.approx(math.hypot(0.5, EXACTNESS), rel=0.03)
    assert found.counted.all()
    # Nine links of six images measure each point about twice; the errors themselves are independent.
    assert found.overdispersion == pytest.approx(9 / 5, rel=0.35)
    assert found.effective == pytest.approx(2.0 * 540 / found.overdispersion, rel=0.02)
    assert found.price == pytest.approx(math.log(found.effective))


def _of_links(seen: Observations) -> NoiseModel:
    return noise_of_links(seen, np.tile(SHIFT, (len(seen), 1, 1)), np.zeros(5))


def test_what_parameters_absorbed_is_added_to_the_noise() -> None:
    errors = independent_errors(each=12).reshape(-1, 2)
    seen = observations(errors.reshape(9, 12, 2))
    whole, apart = NoiseModel.of_errors(seen, errors), _of_links(seen)
    absorbed = 1.0 - 4.0 * 9 / (9 * 12)
    scatter = [math.sqrt(found.noise**2 - EXACTNESS**2) for found in (whole, apart)]
    assert scatter[1] == pytest.approx(scatter[0] / math.sqrt(absorbed))
    few = observations(errors.reshape(9, 12, 2)[:, :4])
    least = _of_links(few)
    whole = NoiseModel.of_errors(few, errors.reshape(9, 12, 2)[:, :4].reshape(-1, 2))
    assert least.noise**2 - EXACTNESS**2 == pytest.approx((whole.noise**2 - EXACTNESS**2) / 0.1)


def test_links_that_do_not_fit_do_not_count() -> None:
    errors = independent_errors()
    errors[4] += 40.0
    found = NoiseModel.of_errors(observations(errors), errors.reshape(-1, 2))
    assert np.flatnonzero(~found.counted).tolist() == list(range(240, 300))
    assert found.noise == pytest.approx(math.hypot(0.5, EXACTNESS), rel=0.2)
    assert len(found.misfit(np.zeros(540))) == 480


def test_the_misfit_is_robust() -> None:
    """``W² log(1 + r² / (σ W)²)`` over the overdispersion, W = 3.5: the square for small errors."""
    found = NoiseModel(0.5, 2.0, np.ones(4, dtype=np.bool_), 100.0)
    misfit = found.misfit(np.array([0.0, 0.0025, 0.25 * 3.5**2, np.inf]))
    np.testing.assert_allclose(misfit[:3], [0.0, 0.005, 0.5 * 3.5**2 * math.log(2.0)], rtol=1e-3)
    assert np.isfinite(misfit[3])
    assert misfit[3] > 100.0


def test_what_cannot_be_transferred_is_infinitely_off() -> None:
    assert squared_lengths(np.array([[3.0, 4.0], [np.nan, 1.0]])).tolist() == [25.0, np.inf]


def test_only_inliers_are_evidence() -> None:
    """Errors beyond 3.5 standard deviations count in the misfit, but are no independent observations."""
    errors = independent_errors(sigma=2.0)
    errors[:, ::10] = [9.0, 6.0]
    seen, flat = observations(errors), errors.reshape(-1, 2)
    found = NoiseModel.of_errors(seen, flat)
    inliers = np.linalg.norm(flat, axis=1) <= 3.5 * math.sqrt(found.noise**2 - EXACTNESS**2)
    assert 0.88 < inliers.mean() <= 0.9
    assert found.counted.all()
    assert found.effective == pytest.approx(2.0 * inliers.sum() / found.overdispersion)


def test_there_are_two_observations_at_least() -> None:
    few = np.full((1, 1, 2), 0.3)
    assert NoiseModel.of_errors(observations(few, 2), few.reshape(-1, 2)).effective == 2.0
