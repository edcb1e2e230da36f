"""Near copies lie where their links and attitudes put them; what is measured in them counts; nothing else moves."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from examples.worlds.alignment_scenes import Scene, grid, grid_scene, jittered, scene, turn_links
from examples.worlds.turns import camera_rotations
from rdstitch.alignment import Alignment, AlignmentOptions, AlignmentTask, align
from rdstitch.alignment.distinct_pairs import options_of_originals
from rdstitch.alignment.frames.quarter_turns import QuarterTurns
from rdstitch.alignment.least_squares.plane_marks import Sighting
from rdstitch.alignment.motion_models import LOG_HEIGHT, PSI, THETA, YAW, X
from rdstitch.alignment.near_copies import without_measurements
from rdstitch.alignment.result import PlanarPoses
from rdstitch.choices import ModelName
from rdstitch.geometry.camera import Camera
from rdstitch.matching.links import Link

NEAR = {6: 4, 7: 4}
LENS = Camera((640, 480), -0.2, focal=554.0, focal_source="guess")


def _scene_with_copies() -> Scene:
    """Six images, and two taken where the fifth was: with the camera tilted by 1.3 degrees, and beside it."""
    rng = np.random.default_rng(2)
    poses = jittered(grid(3, 2, (0.4, 0.3), 0.2, rng), 0.1, np.radians(2.0), rng)
    poses = np.vstack([poses, poses[4], poses[4]])
    poses[6, [PSI, THETA]] += np.radians([1.0, -0.8])
    poses[7, X] += 0.015
    return scene(poses, rng=rng, per_link=120, noise=0.2)


def _task(cameras: Sequence[Camera], links: Sequence[Link], options: AlignmentOptions) -> AlignmentTask:
    evidence, of_copies = list[Link](), list[Link]()
    for link in links:
        (of_copies if NEAR.keys() & {link.image1, link.image2} else evidence).append(link)
    return AlignmentTask(cameras, evidence, options, NEAR, of_copies)


def _without_copies(task: AlignmentTask) -> Alignment:
    return align(task.cameras, task.links, task.options)


@pytest.mark.parametrize(
    ("model", "attitudes_std"),
    [("auto", 0.0), ("auto", np.radians(0.1)), ("auto", None), ("homography", None)],
)
def test_a_near_copy_lies_where_it_was_taken(model: ModelName, attitudes_std: float | None) -> None:
    given = _scene_with_copies()
    options = AlignmentOptions(model=model, lens="division")
    if attitudes_std is not None:
        options = replace(options, attitudes=given.poses[:, [PSI, THETA]], attitudes_std=attitudes_std)
    task = _task(given.cameras, given.links, options)
    alone, found = _without_copies(task), task.result
    assert found.used.all()
    np.testing.assert_array_equal(found.homographies[:6], alone.homographies[:6])
    points = np.array([[40.0, 30.0], [320.0, 240.0], [600.0, 450.0]])
    lens = Camera((640, 480), distortion=given.distortion)
    for copy in NEAR:
        flat = lens.normalize(lens.undistort(points))
        seen = np.column_stack([flat, np.ones(3)]) @ (given.truth[copy] @ np.linalg.inv(given.truth[4])).T
        expected = lens.distort(lens.denormalize(seen[:, :2] / seen[:, 2:]))
        np.testing.assert_allclose(found.transfer(4, copy, points), expected, atol=0.5)
    if attitudes_std is None:
        return
    assert found.poses is not None
    assert alone.poses is not None
    np.testing.assert_array_equal(found.poses.position[:6], alone.poses.position[:6])
    np.testing.assert_allclose(found.poses.tilt[6:], given.poses[6:, [PSI, THETA]], atol=np.radians(0.1))
    apart = np.linalg.norm(found.poses.position[6:] - found.poses.position[4], axis=1)
    np.testing.assert_allclose(apart, [0.0, 0.015 / np.exp(given.poses[alone.reference, 3])], atol=0.002)


def test_covariances_of_near_copies_are_what_they_scatter_by() -> None:
    """Of the reference, which is known exactly, so that all that is stated is of the copies themselves."""
    ratios = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        poses = grid(3, 2, (0.4, 0.3), 0.2, rng)
        poses = np.vstack([poses, poses[4], poses[4]])
        poses[6:, [X, YAW, LOG_HEIGHT]] += rng.normal(scale=(0.02, 0.02, 0.01), size=(2, 3))
        given = scene(poses, rng=rng, per_link=60, noise=0.4)
        options = AlignmentOptions(reference=4, model="similarity", lens="division", pose_covariance=True)
        found, true = _task(given.cameras, given.links, options).result.poses, PlanarPoses.of(poses).relative_to(4)
        assert found is not None
        assert found.covariance is not None
        off = np.column_stack([found.position - true.position, found.height - true.height, found.yaw - true.yaw])
        ratios.append(off[6:] ** 2 / np.einsum("nii->ni", found.covariance[6:]))
    mean = np.concatenate(ratios).mean(axis=0)
    assert (mean > 0.2).all()
    assert (mean < 2.0).all()


def test_near_copies_do_not_turn_the_level_frame() -> None:
    """Three of an image that was held askew, before and after quarter turns."""
    headings, rolls = [0, 20, 40, 60, 80, 100, 79.5, 79.2], [1.0, -2.0, 1.5, -1.0, 6.0, 1.0, 6.2, 6.0]
    rotations = camera_rotations(np.radians(headings), 0.0, np.radians(rolls))
    links = turn_links(LENS, rotations, np.random.default_rng(0))
    task = _task([LENS] * 8, links, AlignmentOptions(lens="division"))
    alone, found = _without_copies(task), task.result
    assert found.on_sphere
    assert found.used.all()
    np.testing.assert_array_equal(found.homographies[:6], alone.homographies[:6])
    points = np.array([[100.0, 80.0], [320.0, 240.0], [500.0, 400.0]])
    for link in task.links_of_copies:
        errors = found.transfer(link.image1, link.image2, link.points1) - link.points2
        assert np.median(np.linalg.norm(errors, axis=1)) < 0.5
    upright = QuarterTurns((6,) * 8)
    turned = [upright.alignment(one, near_copies=NEAR) for one in (alone, found)]
    np.testing.assert_allclose(turned[1].homographies[:6], turned[0].homographies[:6], atol=1e-12)
    assert np.isfinite(turned[1].transfer(4, 6, points)).all()


def test_near_copies_of_images_that_are_not_aligned_are_left_out_with_them() -> None:
    given = grid_scene(3, 2, seed=1, per_link=60)
    between = replace(given.links[0], image1=6, image2=7)
    task = AlignmentTask([given.cameras[0]] * 8, given.links, AlignmentOptions(model="rigid"), {7: 6}, [between])
    assert task.result.used.tolist() == [True] * 6 + [False] * 2
    assert task.result.components == (tuple(range(6)), (6, 7))


@pytest.mark.parametrize(
    ("options", "left"),
    [
        ({}, NEAR),
        ({"reference": 6}, {7: 4}),
        ({"control": (Sighting(7, (0.0, 0.0), "P", (0.0, 0.0)),)}, {6: 4}),
        ({"positions": [[0.0, 0.0]] * 8}, NEAR),
        ({"positions": [[np.nan] * 2] * 7 + [[0.0, 0.0]]}, {6: 4}),
        ({"gravity": [[np.nan] * 3] * 6 + [[0.0, 1.0, 0.0], [np.nan] * 3]}, {7: 4}),
    ],
)
def test_what_is_measured_in_a_near_copy_alone_makes_it_count(options: dict[str, object], left: dict[int, int]) -> None:
    assert without_measurements(NEAR, AlignmentOptions(**options)) == left  # type: ignore[arg-type]


def test_what_a_copy_alone_has_is_given_of_its_image() -> None:
    """The direction of gravity in the axes of that image, where a camera lay on its side, too."""
    rows = {"positions": [3.0, 4.0], "positions_std": 2.0, "gravity": [0.6, 0.0, 0.8]}
    given = {name: np.array([np.full_like(row, np.nan), row]) for name, row in rows.items()}
    options = AlignmentOptions(**given)  # type: ignore[arg-type]
    quarters = QuarterTurns((1, 6))
    found = options_of_originals(options, {1: 0}, quarters)
    np.testing.assert_array_equal(found.positions, [[3.0, 4.0]] * 2)
    np.testing.assert_array_equal(found.positions_std, [2.0, 2.0])
    np.testing.assert_array_equal(found.gravity, [quarters.directions(given["gravity"])[1], rows["gravity"]])
    assert np.isnan(given["positions"][0]).all()


def test_a_position_keeps_its_accuracy_beside_a_copy_that_has_a_better_one() -> None:
    options = AlignmentOptions(positions=[[0.0, 0.0], [9.0, 5.0]], positions_std=[np.nan, 0.02])
    found = options_of_originals(options, {1: 0}, QuarterTurns((1, 1)))
    np.testing.assert_array_equal(found.positions, options.positions)
    np.testing.assert_array_equal(found.positions_std, options.positions_std)
