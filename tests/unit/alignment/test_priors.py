"""Priors of the world as costs, slopes and curvatures."""

import math

import pytest

from rdstitch.alignment.priors import LENS, TILT, Prior, exact, focal_prior

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
