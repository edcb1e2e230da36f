"""Which motion model is taken: misfit against the price of freedom, and homographies for what one camera cannot be."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.model_selection import (
    choose_model,
    fit_cost,
    has_plausible_focal,
    noise_of_links,
    parameter_count,
    price,
)
from rdstitch.alignment.motion_models import HOMOGRAPHY, PLANAR_MODELS, POSE, RIGID, SIMILARITY, TILTING, MotionModel
from rdstitch.alignment.noise_model import EXACTNESS
from rdstitch.alignment.rotation_model import ROTATION
from rdstitch.arrays import FloatArray
from tests.alignment_stubs import (
    ONLY_DISTORTION,
    adjusted,
    even_errors,
    independent_errors,
    observations,
    problem,
)

NAMES = list(PLANAR_MODELS)
SEEN = observations(independent_errors())
BARE = problem(SEEN, lambda model: Fit(model, adjusted(SEEN, np.ones(540)), ONLY_DISTORTION))
NOISE, LEAST = noise_of_links(BARE)


def _problem(squared: Mapping[str, FloatArray], pictures: int = 6, spread: float = 0.0) -> Problem:
    """Each model leaves the squared errors given by its name."""

    def fit(model: MotionModel) -> Fit:
        shared = () if model is HOMOGRAPHY else (0.0, 0.0, 0.0)
        own = adjusted(SEEN, squared[model.name], shared=shared)
        return Fit(model, own, ONLY_DISTORTION, spread if model is TILTING else 0.0)

    return problem(SEEN, fit, pictures)


@pytest.mark.parametrize(
    ("model", "count"),
    [(RIGID, 15 + 3), (SIMILARITY, 20 + 3), (TILTING, 32 + 3), (POSE, 32 + 1), (HOMOGRAPHY, 40), (ROTATION, 15 + 1)],
)
def test_parameters_are_those_of_the_pictures_without_the_gauge(model: MotionModel, count: int) -> None:
    assert parameter_count(BARE, model, ONLY_DISTORTION) == count + 1
    assert parameter_count(BARE, model, np.ones(5, dtype=np.bool_)) == count + 5
    assert price(NOISE, BARE, model, ONLY_DISTORTION) == pytest.approx((count + 1) * math.log(NOISE.effective))


def test_tilts_that_might_be_anything_cost_more() -> None:
    def cost(degrees: float) -> float:
        return fit_cost(NOISE, BARE, Fit(TILTING, adjusted(SEEN, np.ones(540)), ONLY_DISTORTION, math.radians(degrees)))

    plain = float(NOISE.misfit(np.ones(540)).sum()) + price(NOISE, BARE, TILTING, ONLY_DISTORTION)
    assert cost(0.0) == pytest.approx(plain)
    assert cost(2.9) == pytest.approx(plain)
    assert cost(6.0) == pytest.approx(plain + 4.0 * 6 * math.log(2.0))


def test_a_focal_length_costs_what_it_is_off_from_what_is_known() -> None:
    def cost(log_focal: float) -> float:
        own = adjusted(SEEN, np.ones(540), shared=(0.0, 0.0, log_focal))
        return fit_cost(NOISE, BARE, Fit(SIMILARITY, own, ONLY_DISTORTION))

    assert cost(0.2 + 3.0 * 0.3) - cost(0.2) == pytest.approx(9.0)


@pytest.mark.parametrize(("share", "chosen"), [(0.9, "rigid"), (1.1, "similarity")])
def test_freedom_must_pay_for_itself(share: float, chosen: str) -> None:
    """Five heights more cost five times the logarithm of the number of independent observations."""
    high, low = LEAST + 200.0, LEAST + 200.0 - share * 5 * NOISE.price
    squared = {name: even_errors(NOISE, high if name == "rigid" else low) for name in NAMES}
    found = choose_model(_problem(squared), ["rigid", "similarity"])
    assert found.fit.model.name == chosen
    assert found.reason.startswith(f"{chosen}: ")


@pytest.mark.parametrize(("beyond", "fitted"), [(-1.0, ["rigid"]), (1.0, ["rigid", "similarity"])])
def test_models_that_could_not_pay_are_not_tried(beyond: float, fitted: list[str]) -> None:
    """Even with the errors of pairs on their own the next model would cost more."""
    rigid = LEAST + 5 * NOISE.price + beyond
    squared = {name: even_errors(NOISE, rigid) for name in NAMES}
    given = _problem(squared)
    choose_model(given, ["rigid", "similarity"])
    assert given.fitted == fitted  # type: ignore[attr-defined]


@pytest.mark.parametrize(("pictures", "fitted"), [(2, ["rigid", "tilting"]), (3, ["rigid", "tilting", "pose"])])
def test_two_pictures_have_no_pose_of_their_own(pictures: int, fitted: list[str]) -> None:
    squared = {name: even_errors(NOISE, LEAST + 5000.0) for name in NAMES}
    given = _problem(squared, pictures)
    choose_model(given, ["rigid", "tilting", "pose"])
    assert given.fitted == fitted  # type: ignore[attr-defined]


def _of_sigma(sigma: float) -> FloatArray:
    """Squared errors whose median is that of normal errors of this deviation."""
    return np.full(540, (1.1774 * sigma) ** 2)


@pytest.mark.parametrize(
    ("camera", "chosen"),
    [
        (1.45, "pose"),  # relief and an odd lens do as much
        (1.65, "homography"),
    ],
)
def test_homographies_are_for_what_one_camera_cannot_be(camera: float, chosen: str) -> None:
    free = 0.5
    own = math.sqrt((camera * math.hypot(free, EXACTNESS)) ** 2 - EXACTNESS**2)
    squared = {"pose": _of_sigma(own), "homography": _of_sigma(free)}
    assert choose_model(_problem(squared), ["pose", "homography"]).fit.model.name == chosen


def test_homographies_are_not_tried_where_they_could_not_be_taken() -> None:
    squared = {"pose": _of_sigma(0.6), "homography": _of_sigma(0.01)}
    given = _problem(squared)
    assert choose_model(given, ["pose", "homography"]).fit.model is POSE
    assert given.fitted == ["pose"]  # type: ignore[attr-defined]


def test_a_model_that_was_requested_is_taken() -> None:
    squared = {name: even_errors(NOISE, LEAST + 300.0) for name in NAMES}
    for name in ("rigid", "homography"):
        found = choose_model(_problem(squared), [name])
        assert found.fit.model.name == name
        assert "as requested" in found.reason


@pytest.mark.parametrize(("gain", "center", "taken"), [(3.0, 0.02, True), (1.5, 0.02, False), (3.0, 0.6, False)])
def test_more_of_the_lens_is_freed_where_that_pays(gain: float, center: float, taken: bool) -> None:
    """The two coordinates of the centre cost two prices; a centre far off is no lens."""
    squared = {name: even_errors(NOISE, LEAST + 300.0) for name in NAMES}
    given: Any = _problem(squared)
    lens = np.array([False, False, False, True, True])
    better = adjusted(
        SEEN, even_errors(NOISE, LEAST + 300.0 - gain * NOISE.price), lens=(0, 0, 0, center, 0), shared=(0, 0, 0)
    )
    wider = Fit(RIGID, better, lens | ONLY_DISTORTION)
    given.extend = lambda fit, lens: wider
    assert (choose_model(given, ["rigid"], [lens]).fit is wider) is taken


def test_of_two_pictures_a_homography_is_always_tried() -> None:
    """It needs no more parameters than one camera does."""
    tailed = np.where(np.arange(540) % 5 < 3, _of_sigma(0.6), 16.0)  # a small scatter, and a large misfit
    squared = {"rigid": tailed, "homography": even_errors(NOISE, LEAST + 1.0)}
    for pictures, fitted in ((2, ["rigid", "homography"]), (3, ["rigid"])):
        given: Any = _problem(squared, pictures)
        choose_model(given, ["rigid", "homography"])
        assert given.fitted == fitted, pictures


@pytest.mark.parametrize(("focal", "plausible"), [(0.1, False), (0.3, True), (2.0, True), (80.0, False)])
def test_no_model_asks_for_a_focal_length_that_no_lens_has(focal: float, plausible: bool) -> None:
    """Over relief, free tilts may: of 640 x 480 pixels 15."""

    class Adjusted:
        class parameters:  # noqa: N801
            shared = TILTING.shared_from_physical(np.array([0.01, 0.02, math.log(focal)]))

    fit: Any = Fit(TILTING, Adjusted, np.zeros(5, dtype=np.bool_))  # type: ignore[arg-type]
    assert has_plausible_focal(fit) is plausible
    free: Any = Fit(HOMOGRAPHY, Adjusted, np.zeros(5, dtype=np.bool_))  # type: ignore[arg-type]
    assert has_plausible_focal(free)
