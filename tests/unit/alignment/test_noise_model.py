"""How many of the errors of links on their own are independent."""

import numpy as np
import pytest

from rdstitch.alignment.link_equations import squared_lengths
from rdstitch.alignment.noise import evidence_of
from rdstitch.alignment.noise import independent_errors as independent
from rdstitch.robust.posterior import EXACTNESS
from tests.alignment_stubs import SHIFT, independent_errors, observations


def _found(errors: np.ndarray, images: int = 6) -> tuple[float, float]:
    seen = observations(errors, images)
    return independent(seen, np.tile(SHIFT, (len(seen), 1, 1)), np.zeros(5))


def test_links_measure_points_again_and_only_inliers_of_links_that_fit_count() -> None:
    errors = independent_errors(sigma=0.5)
    shared, count = _found(errors)
    # Nine links of six images measure each point about twice; the errors themselves are independent.
    assert shared == pytest.approx(9 / 5, rel=0.35)
    assert count == pytest.approx(2.0 * 540 / shared, rel=0.02)
    errors[4] += 40.0
    errors[0, ::10] = [9.0, 6.0]
    shared, count = _found(errors)
    assert count == pytest.approx(2.0 * (480 - 6) / shared, rel=0.02)


def test_there_are_two_observations_at_least() -> None:
    assert _found(np.full((1, 1, 2), 0.3), 2)[1] == 2.0


def test_what_cannot_be_transferred_is_infinitely_off() -> None:
    assert squared_lengths(np.array([[3.0, 4.0], [np.nan, 1.0]])).tolist() == [25.0, np.inf]


@pytest.mark.parametrize(("sigma", "noise"), [(0.5, 0.5), (0.01, EXACTNESS)])
def test_the_noise_is_the_scatter_or_what_no_model_is_exact_to(sigma: float, noise: float) -> None:
    errors = independent_errors(sigma=sigma)
    assert evidence_of(observations(errors), errors.reshape(-1, 2)).noise[0] == pytest.approx(noise, rel=0.05)
