"""Positions hold a chain over rough ground in shape where the images agree with them, and do nothing elsewhere."""

from functools import cache

import numpy as np

from rdstitch.alignment import Alignment, AlignmentOptions, align
from rdstitch.alignment.motion_models import X, Y
from rdstitch.arrays import FloatArray
from tests.alignment_scenes import Scene, grid, scene

_HEIGHT = 300.0
"""Metres above the ground."""


@cache
def _strip(relief: float) -> Scene:
    """Of 30 images: a shorter one keeps its shape without positions."""
    rng = np.random.default_rng(1)
    return scene(grid(30, 1, (0.4, 0.1), 0.1, rng), per_link=50, relief=relief, rng=rng, focal_source="exif", reach=2)


def _positions(given: Scene, std: float) -> FloatArray:
    """Metres east and north, in a plane turned by 40 degrees."""
    metres = _HEIGHT * (given.poses[:, [X, Y]] @ [1.0, -1.0j]) * np.exp(0.7j) + 30.0
    noise = np.random.default_rng(2).normal(0.0, std, (2, len(metres)))
    return np.stack([metres.real + noise[0], metres.imag + noise[1]], axis=1)


def _aligned(given: Scene, positions: FloatArray | None) -> Alignment:
    options = AlignmentOptions(model="similarity", lens="division", positions=positions)
    return align(given.cameras, given.links, options)


@cache
def _without(relief: float) -> Alignment:
    return _aligned(_strip(relief), None)


def _bend(found: Alignment, given: Scene) -> float:
    """Largest distance of an image from its place after a similarity, in lengths of the strip."""
    a, b = (places @ [1.0, 1.0j] for places in (found.poses.position, given.poses[:, [X, Y]]))
    a, b = a - a.mean(), b - b.mean()
    return float(np.abs(b - np.vdot(a, b) / np.vdot(a, a) * a).max() / np.ptp(b.real))


def test_positions_hold_a_strip_over_hills_in_shape() -> None:
    given = _strip(0.3)
    without, held = _without(0.3), _aligned(given, _positions(given, 2.0))
    assert _bend(without, given) > 0.008
    assert _bend(held, given) < 0.6 * _bend(without, given)
    assert held.messages == ()


def test_some_images_without_a_position_and_two_far_off_do_no_harm() -> None:
    given = _strip(0.15)
    positions = _positions(given, 2.0)
    positions[[3, 7, 8]] = np.nan
    positions[5] += 400.0
    positions[20] = -5e6
    assert _bend(_aligned(given, positions), given) < 0.6 * _bend(_without(0.15), given)


def test_over_a_plane_positions_change_nothing_that_the_images_know() -> None:
    given = _strip(0.0)
    without, held = _without(0.0), _aligned(given, _positions(given, 3.0))
    assert abs(held.distortion - without.distortion) < 0.2 * without.distortion_std
    assert _bend(held, given) < _bend(without, given) + 0.001


def test_positions_that_the_images_contradict_are_not_used_and_named() -> None:
    given = _strip(0.0)
    positions = np.random.default_rng(3).permutation(_positions(given, 2.0))
    without, ignored = _without(0.0), _aligned(given, positions)
    np.testing.assert_array_equal(ignored.homographies, without.homographies)
    assert [message.text[:28] for message in ignored.messages] == ["the GPS positions contradict"]


def test_positions_of_one_place_say_nothing() -> None:
    given = _strip(0.0)
    positions = np.random.default_rng(4).normal(0.0, 3.0, (len(given.cameras), 2))
    found = _aligned(given, positions)
    np.testing.assert_array_equal(found.homographies, _without(0.0).homographies)
    assert found.messages == ()
