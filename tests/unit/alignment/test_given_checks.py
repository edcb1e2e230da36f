"""Attitudes and tilts that the images contradict are not used, and the message says which would fit."""

import math
from importlib import import_module

import numpy as np
import pytest

from examples.worlds.alignment_scenes import Scene, aligned, grid, grid_scene, jittered, scene
from rdstitch.alignment import AlignmentOptions, AlignmentTask, align
from rdstitch.alignment.build_result import AdjustedImages, build_alignment
from rdstitch.alignment.motion_models import PSI, THETA
from rdstitch.alignment.result import Alignment
from rdstitch.arrays import FloatArray
from rdstitch.errors import ImpossibleCameraError
from rdstitch.inputs.delays import DELAYS

_ONE = math.radians(1.0)


@pytest.fixture(scope="module")
def windy() -> tuple[Scene, FloatArray]:
    """A drone whose tilts scatter by 3 degrees, and what an IMU measures of them to 0.2 degrees."""
    rng = np.random.default_rng(2)
    poses = jittered(grid(4, 3, (0.4, 0.3), 0.25, rng), 0.1, math.radians(3.0), rng)
    given = scene(poses, focal_source="exif", rng=rng, per_link=80)
    return given, poses[:, [PSI, THETA]] + rng.normal(scale=math.radians(0.2), size=(12, 2))


def _aligned(given: Scene, attitudes: FloatArray | None, std: float) -> Alignment:
    return aligned(given, lens="division", attitudes=attitudes, attitudes_std=std)


@pytest.fixture(scope="module")
def plain(windy: tuple[Scene, FloatArray]) -> Alignment:
    return _aligned(windy[0], None, _ONE)


def test_right_attitudes_are_used_as_well_as_they_are(windy: tuple[Scene, FloatArray]) -> None:
    given, measured = windy
    right = _aligned(given, measured, math.radians(0.2))
    assert not right.messages
    assert right.used.all()
    assert right.tilt_spread == math.radians(0.2)
    optimistic = _aligned(given, measured, 0.0)
    assert 0.1 < math.degrees(optimistic.tilt_spread) < 0.4
    (note,) = optimistic.messages
    assert note.severity == "note"
    assert optimistic.rms < 1.05 * right.rms


@pytest.mark.parametrize(
    ("change", "std", "named"),
    [
        ([[-1, 0], [0, -1]], _ONE, "with -psi for psi and -theta for theta they"),
        ([[1, 0], [0, -1]], 0.0, "with -theta for theta they"),
        ([[0, 1], [1, 0]], 0.2 * _ONE, "with theta for psi and psi for theta they"),
        # -theta was written as psi, and psi as theta: what was written as theta is psi, and so on.
        ([[0, -1], [1, 0]], _ONE, "with theta for psi and -psi for theta they"),
    ],
)
def test_wrong_signs_and_orders_are_named_and_not_used(
    windy: tuple[Scene, FloatArray], plain: Alignment, change: list[list[int]], std: float, named: str
) -> None:
    given, measured = windy
    found = _aligned(given, measured @ np.array(change).T, std)
    (message,) = found.messages
    assert (message.severity, message.code) == ("warning", "attitudes-contradicted")
    assert named in message.text
    assert found.rms == plain.rms
    np.testing.assert_array_equal(found.homographies, plain.homographies)


def test_attitudes_of_other_images_are_not_used(windy: tuple[Scene, FloatArray]) -> None:
    given, measured = windy
    (message,) = _aligned(given, np.roll(measured, 5, axis=0), math.radians(0.2)).messages
    assert "no signs and no order" in message.text


def test_attitudes_that_say_less_than_their_scatter_are_no_contradiction() -> None:
    rng = np.random.default_rng(3)
    given = scene(grid(4, 3, (0.4, 0.3), 0.25, rng), tilt=(0.04, -0.03), rng=rng, per_link=120)
    assert _aligned(given, rng.normal(scale=_ONE, size=(12, 2)), _ONE).messages == ()


@pytest.mark.parametrize(("tilt", "right"), [((0.05, -0.03), True), ((-0.05, 0.03), False), ((0.05, 0.03), False)])
def test_a_tilt_of_the_wrong_sign_is_not_used(tilt: tuple[float, float], right: bool) -> None:
    given = grid_scene(4, 3, (0.5, 0.4), 0.3, seed=5, tilt=(0.05, -0.03), per_link=80)
    found = aligned(given, lens="division", tilt=tilt)
    assert (found.messages == ()) == right
    assert found.tilt == pytest.approx((0.05, -0.03), abs=0.002)
    assert right or "they show 2.8" in found.messages[0].text


def test_any_tilt_is_compared_with_the_one_that_the_images_show() -> None:
    """As far as another distortion centre does not explain the difference."""
    given = grid_scene(4, 3, (0.5, 0.4), 0.3, seed=5, tilt=(0.14, -0.05), per_link=80)
    wrong, near = (aligned(given, lens="division", tilt=tilt) for tilt in ((0.02, 0.02), (0.12, -0.04)))
    assert [message.code for message in wrong.messages] == ["attitudes-contradicted"]
    assert wrong.tilt == pytest.approx((0.14, -0.05), abs=0.002)
    assert near.messages == ()


def test_a_turn_that_was_asked_for_is_taken_beside_a_given_tilt() -> None:
    given = grid_scene(2, 2, seed=5, per_link=40)
    assert aligned(given, model="rotation", tilt=(0.05, -0.03)).model == "rotation"


@pytest.mark.parametrize(
    ("factor", "right", "tilt_given"), [(1.15, False, False), (0.85, False, True), (1.01, True, False)]
)
def test_a_focal_length_that_the_images_contradict_is_not_used(factor: float, right: bool, tilt_given: bool) -> None:
    tilt = (math.radians(8.0), math.radians(-5.0))
    given = grid_scene(4, 3, yaw=0.25, seed=3, tilt=tilt, per_link=80)
    true = given.cameras[0].with_guessed_focal().focal
    told = [camera.with_focal(factor * true, "option") for camera in given.cameras]
    alignment = align(told, given.links, AlignmentOptions(lens="division", tilt=tilt if tilt_given else None))
    found = [message for message in alignment.messages if message.code == "focal-contradicted"]
    assert bool(found) is not right
    assert right or f"they show {alignment.cameras[0].focal:.1f}" in found[0].text
    assert abs(math.log(alignment.cameras[0].focal / true)) < 4.0 * alignment.length_std
    if tilt_given or right:
        assert alignment.length_std < 0.012


def test_a_focal_length_stays_given_where_no_camera_is_possible_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    given = grid_scene(4, 3, yaw=0.25, seed=3, tilt=(0.14, -0.09), per_link=80)
    told = [camera.with_focal(1.15 * camera.with_guessed_focal().focal, "option") for camera in given.cameras]
    recipe = import_module(AlignmentTask.__module__)

    def build(adjusted: AdjustedImages) -> Alignment:
        if any(message.code == "focal-contradicted" for message in adjusted.messages):
            raise ImpossibleCameraError("the corners would see behind the camera")
        return build_alignment(adjusted)

    monkeypatch.setattr(recipe, "build_alignment", build)
    found = align(told, given.links, AlignmentOptions(lens="division"))
    assert not any(message.code == "focal-contradicted" for message in found.messages)


@pytest.mark.parametrize(
    ("sign", "named"), [(1.0, ["focal-contradicted"]), (-1.0, ["attitudes-contradicted", "focal-contradicted"])]
)
def test_beside_a_wrong_focal_length_attitudes_are_named_only_if_they_are_wrong(sign: float, named: list[str]) -> None:
    wind = 0.1, math.radians(6.0)
    given = grid_scene(4, 3, yaw=0.25, seed=2, focal_source="exif", per_link=80, wind=wind)
    true = given.cameras[0].with_guessed_focal().focal
    told = [camera.with_focal(1.2 * true, "option") for camera in given.cameras]
    attitudes = sign * given.poses[:, [PSI, THETA]]
    options = AlignmentOptions(lens="division", attitudes=attitudes, attitudes_std=math.radians(0.1))
    found = align(told, given.links, options)
    assert sorted(message.code for message in found.messages) == named
    assert abs(math.log(found.cameras[0].focal / true)) < 4.0 * found.length_std


@pytest.mark.parametrize("late", [0.04, 0.0])
def test_attitudes_that_are_late_are_taken_for_when_they_were(late: float) -> None:
    rng = np.random.default_rng(2)

    def tilts(times: FloatArray) -> FloatArray:
        return 0.03 * np.stack([np.sin(4.1 * times), np.cos(3.3 * times)], axis=-1)

    poses, times = grid(4, 3, (0.4, 0.3), 0.25, rng), np.linspace(0.0, 3.3, 12)
    poses[:, [PSI, THETA]] = tilts(times)
    given = scene(poses, focal_source="exif", rng=rng, per_link=80)
    measured = tilts(times[:, None] + DELAYS - late) + rng.normal(scale=math.radians(0.02), size=(12, len(DELAYS), 2))
    options = AlignmentOptions(
        lens="division",
        attitudes=measured[:, len(DELAYS) // 2],
        delayed_attitudes=measured,
        attitudes_std=math.radians(0.05),
    )
    found = align(given.cameras, given.links, options)
    assert [message.code for message in found.messages] == (["attitudes-late"] if late else [])
    if late:
        assert "40 ±" in found.messages[0].text or "39 ±" in found.messages[0].text or "41 ±" in found.messages[0].text
    assert found.rms < 1.02 * _aligned(given, tilts(times), math.radians(0.05)).rms
