"""Turn on the spot or motion over a plane: what is tried, and what is taken."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.model_selection import noise_of_links, price
from rdstitch.alignment.motion_models import RIGID, TILTING, MotionModel
from rdstitch.alignment.noise_model import EXACTNESS
from rdstitch.alignment.rotation_model import ROTATION, rotation_from_vector
from rdstitch.alignment.turn_or_plane import choose_motion
from rdstitch.arrays import FloatArray
from tests.alignment_stubs import (
    ONLY_DISTORTION,
    SCALE,
    adjusted,
    even_errors,
    independent_errors,
    observations,
    problem,
)

SEEN = observations(independent_errors())
BARE = problem(SEEN, lambda model: Fit(model, adjusted(SEEN, np.ones(540)), ONLY_DISTORTION))
NOISE, LEAST = noise_of_links(BARE)


def _of_sigma(sigma: float) -> FloatArray:
    return np.full(540, (1.1774 * sigma) ** 2)


def _with_tail(sigma: float) -> FloatArray:
    """The same scatter, with many large errors besides."""
    return np.where(np.arange(540) % 5 < 3, _of_sigma(sigma), 16.0)


def _problem(
    turn: FloatArray,
    plane: FloatArray,
    *,
    degrees: float = 0.0,
    trial: float = 0.5,
    log_focal: float = 0.2,
    sways: Fit | None = None,
) -> Any:
    """A turn that leaves squared errors, by so many degrees; motions over a plane that leave others, one as given."""
    half = rotation_from_vector(np.array([[0.0, math.radians(degrees / 6), 0.0]]))[0]
    poses = np.stack([np.linalg.matrix_power(half, k) for k in (0, 1, 2, 3, 4, 6)]).reshape(-1, 9)

    def fit(model: MotionModel) -> Fit:
        if model is ROTATION:
            return Fit(model, adjusted(SEEN, turn, poses=poses, shared=(log_focal,)), ONLY_DISTORTION)
        if sways is not None and model is sways.model:
            return sways
        return Fit(model, adjusted(SEEN, plane, shared=(0.0, 0.0, 0.0)), ONLY_DISTORTION)

    tried: Any = SimpleNamespace(sigma=trial, parameters=SimpleNamespace(shared=np.array([log_focal])))
    return problem(SEEN, fit, trial=lambda model: tried)


def _chosen(given: Problem, *names: str) -> str:
    return choose_motion(given, list(names) or ["rigid", "rotation"]).fit.model.name


def test_without_the_turn_among_the_models_it_is_not_tried() -> None:
    given = _problem(_of_sigma(0.5), _of_sigma(0.5))
    assert _chosen(given, "rigid") == "rigid"
    assert given.fitted == ["rigid"]


def test_a_turn_that_was_requested_is_taken_whatever_it_leaves() -> None:
    given = _problem(_of_sigma(50.0), _of_sigma(0.5), trial=50.0)
    found = choose_motion(given, ["rotation"])
    assert found.fit.model is ROTATION
    assert "as requested" in found.reason


@pytest.mark.parametrize(("times", "tried"), [(3.9, True), (4.1, False)])
def test_a_turn_is_tried_only_where_pairs_could_be_one(times: float, tried: bool) -> None:
    given = _problem(_of_sigma(3.0), _of_sigma(0.5), trial=times * NOISE.noise)
    _chosen(given)
    assert ("rotation" in given.fitted) is tried


@pytest.mark.parametrize(("degrees", "sigma", "plane_tried"), [(50, 0.55, False), (40, 0.55, True), (50, 0.66, True)])
def test_a_camera_that_turned_far_was_over_no_plane(degrees: float, sigma: float, plane_tried: bool) -> None:
    """As good as pairs on their own: within 1.2 times their noise."""
    given = _problem(_with_tail(sigma), _of_sigma(0.5), degrees=degrees)
    name = _chosen(given)
    assert ("rigid" in given.fitted) is plane_tried
    assert plane_tried or name == "rotation"
    assert math.hypot(0.55, EXACTNESS) < 1.2 * NOISE.noise < math.hypot(0.66, EXACTNESS)


def test_a_hand_held_turn_may_have_some_parallax() -> None:
    """Up to 0.0015 of the diagonal, where no level camera over a plane explains the pictures."""
    size = 0.0015 * 2.0 * SCALE
    for sigma, plane, name in (
        (0.9 * size, 3.0, "rotation"),
        (0.9 * size, 0.7, "rotation"),  # better, but not as good as pairs on their own
        (0.9 * size, 0.5, "rigid"),
        (1.1 * size, 0.7, "rigid"),
    ):
        given = _problem(_of_sigma(sigma), _of_sigma(plane), degrees=60, trial=1.0)
        assert _chosen(given) == name, (sigma, plane)


@pytest.mark.parametrize(
    ("degrees", "name"), [(1.0, "tilting"), (5.0, "tilting"), (7.0, "rotation"), (14.0, "rotation")]
)
def test_a_camera_that_sways_over_a_plane_did_not_turn_by_hand(degrees: float, name: str) -> None:
    """Pictures of a drone fitted a turn by 50 degrees to 0.0013 of the diagonal; tilts of one degree were better."""
    sways = Fit(TILTING, adjusted(SEEN, _of_sigma(0.5), shared=(0.0,) * 3), ONLY_DISTORTION, math.radians(degrees))
    given = _problem(_of_sigma(0.0013 * 2.0 * SCALE), _of_sigma(3.0), degrees=60, trial=1.0, sways=sways)
    assert _chosen(given, "rigid", "tilting", "rotation") == name


@pytest.mark.parametrize(("beyond", "plane_tried"), [(-1.0, False), (1.0, True)])
def test_where_freedom_could_gain_nothing_no_plane_is_tried(beyond: float, plane_tried: bool) -> None:
    """A turn has as many poses as a rigid motion, and two shared parameters fewer."""
    spare = price(NOISE, BARE, RIGID, ONLY_DISTORTION) - price(NOISE, BARE, ROTATION, ONLY_DISTORTION)
    assert spare == pytest.approx(2 * NOISE.price)
    given = _problem(even_errors(NOISE, LEAST + spare + beyond), _of_sigma(0.5))
    _chosen(given)
    assert ("rigid" in given.fitted) is plane_tried


@pytest.mark.parametrize(("share", "name"), [(0.8, "rotation"), (1.2, "rigid")])
def test_the_better_of_both_after_their_prices(share: float, name: str) -> None:
    high, spare = LEAST + 100.0, 2 * NOISE.price
    given = _problem(even_errors(NOISE, high), even_errors(NOISE, high - share * spare))
    assert _chosen(given) == name


def test_a_focal_length_beyond_all_lenses_counts_against_a_turn() -> None:
    """Ten standard deviations of its prior cost a hundred."""
    high = LEAST + 300.0
    plane = even_errors(NOISE, high - 2 * NOISE.price - 50.0)
    for log_focal, name in ((0.2, "rigid"), (0.2 + 0.3 * 5.0, "rigid")):
        assert _chosen(_problem(even_errors(NOISE, high), plane, log_focal=log_focal)) == name
    plane = even_errors(NOISE, high - 2 * NOISE.price + 50.0)
    for deviations, name in ((0.0, "rotation"), (7.0, "rotation"), (7.2, "rigid"), (-7.2, "rigid")):
        given = _problem(even_errors(NOISE, high), plane, log_focal=0.2 + 0.3 * deviations)
        assert _chosen(given) == name, deviations
