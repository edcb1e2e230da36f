"""Positions and control points hold a chain in shape where the images agree with them, and do nothing elsewhere."""

from dataclasses import replace
from functools import cache

import numpy as np

from examples.worlds.alignment_scenes import Scene, grid, grid_scene, jittered
from rdstitch.alignment import Alignment, AlignmentOptions, align
from rdstitch.alignment.least_squares.plane_marks import PlaneMarks, Sighting
from rdstitch.alignment.motion_models import TILTING, X, Y
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import from_plane, to_plane

_HEIGHT = 300.0
"""Metres above the ground."""


@cache
def _strip(relief: float) -> Scene:
    """Of 30 images: a shorter one keeps its shape without positions."""
    return grid_scene(30, 1, (0.4, 0.1), 0.1, seed=1, per_link=50, relief=relief, focal_source="exif", reach=2)


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


def test_positions_that_the_images_contradict_are_not_used_and_named_and_those_of_one_place_say_nothing() -> None:
    given = _strip(0.0)
    for positions, told in (
        (np.random.default_rng(3).permutation(_positions(given, 2.0)), ["the GPS positions contradict"]),
        (np.random.default_rng(4).normal(0.0, 3.0, (len(given.cameras), 2)), []),
    ):
        ignored = _aligned(given, positions)
        np.testing.assert_array_equal(ignored.homographies, _without(0.0).homographies)
        assert [message.text[:28] for message in ignored.messages] == told


def test_errors_of_marks_have_the_derivatives_that_are_told() -> None:
    rng = np.random.default_rng(0)
    poses = jittered(grid(3, 1, (0.4, 0.1), 0.5, rng), 0.1, 0.05, rng)
    shared, lens = np.array([0.05, -0.03, 0.2]), np.array([-0.2, 0.01, 0.0, 0.01, -0.02])
    free = np.array([True, True, False, True, True])
    image, points = np.array([0, 2, 2, 1]), rng.uniform(-0.5, 0.5, (4, 2))
    marks = PlaneMarks(image, points, rng.normal(size=(4, 2)), np.ones(4))

    def errors(step: FloatArray) -> FloatArray:
        moved = lens.copy()
        moved[free] += step[21:]
        at = shared + step[18:21]
        matrices = TILTING.matrices(TILTING.retract(poses, step[:18].reshape(3, 6)), at).matrices
        return marks.places(matrices, moved, float(np.exp(at[-1]))) - marks.target

    told, derivative = marks.equations(TILTING.matrices(poses, shared), lens, free, float(np.exp(0.2)))
    np.testing.assert_allclose(told, errors(np.zeros(25)))
    steps = 1e-6 * np.eye(25)
    shown = np.stack([(errors(step) - errors(-step)) / 2e-6 for step in steps], axis=2)
    columns = np.concatenate([6 * image[:, None] + np.arange(6), np.tile(np.arange(18, 25), (4, 1))], axis=1)
    np.testing.assert_allclose(derivative, np.take_along_axis(shown, columns[:, None], axis=2), atol=1e-6)


def _control(given: Scene, places: FloatArray, *, off: FloatArray | float = 0.0) -> tuple[Sighting, ...]:
    """Points (N, 2) on the plane, each in the two images nearest to it, on a map turned by 40 degrees."""
    lens = Camera(given.cameras[0].image_size, distortion=given.distortion)
    sightings = []
    metres = (places @ [1.0, -1.0j]) * _HEIGHT * np.exp(0.7j) + off
    for number, (place, on_map) in enumerate(zip(places, metres.tolist(), strict=True)):
        for k in np.argsort(np.linalg.norm(given.poses[:, [X, Y]] - place, axis=1))[:2].tolist():
            pixel = from_plane(lens, np.linalg.inv(given.truth[k]), place[None])[0]
            offset = tuple((pixel - np.array(given.cameras[k].center)).tolist())
            sightings.append(Sighting(k, offset, f"P{number}", (on_map.real, on_map.imag), 0.05))
    return tuple(sightings)


def _off(found: Alignment, sightings: tuple[Sighting, ...]) -> FloatArray:
    """Distances of points from their places after the best similarity, metres."""
    seen, places = [], []
    for one in sightings:
        camera = found.cameras[one.image]
        x, y = to_plane(camera, found.homographies[one.image], np.add(one.offset, camera.center)[None])[0]
        seen.append(complex(x, -y))
        places.append(complex(*one.place))
    a, b = np.array(seen) - np.mean(seen), np.array(places) - np.mean(places)
    off: FloatArray = np.abs(b - np.vdot(a, b) / np.vdot(a, a) * a)
    return off


def _along(given: Scene, count: int) -> FloatArray:
    """So many places along the strip."""
    along = np.linspace(given.poses[0, X], given.poses[-1, X], count)
    return np.stack([along, np.interp(along, given.poses[:, X], given.poses[:, Y])], axis=1)


def test_a_strip_bends_back_onto_its_control_points() -> None:
    """Points that take no part are much nearer too, and what is told of leaving one out is no less than that."""
    given = _strip(0.3)
    places = _along(given, 13)
    control, checks = _control(given, places[::3]), _control(given, places[1::3])
    options = AlignmentOptions(model="similarity", lens="division", control=control)
    without, held = _without(0.3), align(given.cameras, given.links, options)
    assert np.sqrt(np.mean(_off(without, control) ** 2)) > 10.0
    assert np.sqrt(np.mean(_off(held, control) ** 2)) < 1.0
    assert np.sqrt(np.mean(_off(held, checks) ** 2)) < 0.4 * np.sqrt(np.mean(_off(without, checks) ** 2))
    assert held.messages == ()
    assert min(held.leverage[f"P{number}"] for number in range(5)) > 0.5


def test_control_points_that_the_images_contradict_bend_nothing() -> None:
    given = _strip(0.0)
    along = given.poses[[0, 5, 12, 20, 29]][:, [X, Y]]
    off = np.random.default_rng(5).normal(0.0, 200.0, (5, 2)) @ [1.0, 1.0j]
    control = _control(given, along, off=off)
    found = align(given.cameras, given.links, AlignmentOptions(model="similarity", lens="division", control=control))
    assert _bend(found, given) < _bend(_without(0.0), given) + 0.001


def test_one_wrong_control_point_of_eight_does_no_harm() -> None:
    given = _strip(0.3)
    places = _along(given, 15)
    control, checks = _control(given, places[::2], off=np.eye(8)[3] * 150.0), _control(given, places[1::2])
    options = AlignmentOptions(model="similarity", lens="division", control=control)
    held = align(given.cameras, given.links, options)
    assert np.sqrt(np.mean(_off(held, checks) ** 2)) < 0.4 * np.sqrt(np.mean(_off(_without(0.3), checks) ** 2))


def test_control_points_in_one_place_say_nothing() -> None:
    given = _strip(0.15)
    control = tuple(replace(one, place=(1.0, 2.0)) for one in _control(given, _along(given, 13))[0:8:2])
    options = AlignmentOptions(model="similarity", lens="division", control=control)
    assert align(given.cameras, given.links, options).leverage == {}
