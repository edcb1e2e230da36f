"""Turning on the spot: derivatives of the model, the level frame, a turn or a plane; the image whose frame it is."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from examples.worlds.alignment_scenes import aligned, scene, turn_links
from examples.worlds.turns import camera_rotations, panorama_rotations
from rdstitch.alignment import Alignment, align
from rdstitch.alignment.frames.level_frame import level_frame, measured_down
from rdstitch.alignment.frames.reference_frame import frontal_reference, in_frame_of
from rdstitch.alignment.motion_models import POSE, PSI, X
from rdstitch.alignment.motion_models.rotation import ROTATION, rotation_from_vector
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.planar_motion import nearest_rotation
from rdstitch.matching.links import Link

LENS = Camera((640, 480), -0.2, focal=554.0, focal_source="guess")


def _links(rotations: FloatArray, rng: np.random.Generator, **options: Any) -> list[Link]:
    return turn_links(LENS, rotations, rng, **options)


def test_rotations_are_found_in_scaled_and_negated_matrices() -> None:
    rotations = camera_rotations([0.3, 2.0, -1.0], [0.2, -0.4, 0.1])
    np.testing.assert_allclose(nearest_rotation(2.5 * rotations), rotations, atol=1e-12)
    shared = np.array([0.3])
    matrices = ROTATION.matrices(rotations.reshape(-1, 9), shared).matrices
    np.testing.assert_allclose(
        ROTATION.nearest_poses(-3.0 * matrices, shared, np.zeros((3, 2))), rotations.reshape(-1, 9), atol=1e-12
    )
    turned = rotation_from_vector(np.array([[0.0, 0.2, 0.0], [0.0, 3.0, 0.0]]))
    np.testing.assert_allclose(turned[0] @ turned[0].T, np.eye(3), atol=1e-12)
    assert np.arccos((np.trace(turned[0]) - 1) / 2) == pytest.approx(0.2)
    assert np.arccos((np.trace(turned[1]) - 1) / 2) == pytest.approx(0.5)  # long steps are shortened


@pytest.mark.parametrize("pitch", [-0.5, 0.0, 0.4])
def test_the_horizon_is_level_whatever_the_frame(pitch: float) -> None:
    headings = np.radians([0, 25, 55, 90, 130])
    level = camera_rotations(headings, pitch)
    anyhow = level @ camera_rotations(0.7, 0.5, -0.9)[0]
    frame = level_frame(anyhow, 2)
    ahead = (anyhow @ frame.T)[:, 2]
    np.testing.assert_allclose(ahead[:, 1], -np.sin(pitch), atol=1e-9)
    # The middle of what is shown lies ahead.
    middle = np.degrees(np.arctan2(ahead[:, 0], ahead[:, 2]))
    assert middle.min() == pytest.approx(-65.0, abs=1e-6)
    assert middle.max() == pytest.approx(65.0, abs=1e-6)


def test_neither_a_roll_of_hands_nor_a_camera_on_its_side_tips_the_horizon() -> None:
    """Two images one above the other hardly turn about the vertical; their x axes alone say 45 degrees."""
    rotations = camera_rotations(np.radians([0.0, 3.0]), np.radians([-5.0, 5.0]), np.radians([1.5, -1.5]))
    ahead = (rotations @ level_frame(rotations, 0).T)[:, 2]
    assert np.abs(np.degrees(np.arcsin(ahead[:, 1].mean()))) < 15.0
    heading, roll = np.radians(np.arange(6) * 25.0), np.radians([2.0, -1.0, 91.0, -2.0, -89.0, 1.0])
    rotations = camera_rotations(heading, 0.1, roll)
    down = (rotations @ level_frame(rotations, 0).T)[:, :, 1]
    np.testing.assert_allclose(down[:, 2], -np.sin(0.1), atol=0.03)
    np.testing.assert_allclose(np.degrees(np.arctan2(down[:, 0], down[:, 1])), np.degrees(roll), atol=2.0)
    # A full turn has the reference image ahead.
    rotations = camera_rotations(np.arange(12) * np.pi / 6)
    ahead = (rotations @ level_frame(rotations, 5).T)[5, 2]
    np.testing.assert_allclose(ahead, (0.0, 0.0, 1.0), atol=1e-9)


def test_an_image_that_looks_straight_down_or_up_has_a_level_frame() -> None:
    rotations = camera_rotations([0.0, 0.3], [0.0, 0.2])
    for down in (rotations[0, 2], -rotations[0, 2]):
        frame = level_frame(rotations, 0, down)
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(frame) == pytest.approx(1.0)
        np.testing.assert_allclose(frame[1], down, atol=1e-12)


def test_gravity_that_contradicts_itself_levels_nothing_in_any_unit() -> None:
    turns = rotation_from_vector(np.array([[0.0, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.4, 0.0]]))
    down = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [np.nan] * 3])
    scattered = np.array([[0.5, 1.0, 0.0], [-0.5, 1.0, 0.0], [0.0, 1.0, 0.9]])
    for unit in (1.0, 9.81, 0.01):
        np.testing.assert_allclose(measured_down(turns, unit * down), [0.0, 1.0, 0.0], atol=1e-12)
        assert measured_down(turns, unit * scattered) is None
    assert measured_down(turns, np.zeros((3, 3))) is None


def test_the_focal_length_of_a_turn_is_that_of_its_matrices_beyond_the_limits_of_lenses() -> None:
    for shared in (np.log([100.0]), np.log([0.1]), np.log([1.3])):
        (matrix,) = ROTATION.matrices(np.eye(3).reshape(1, 9), shared).matrices
        np.testing.assert_allclose(matrix[0, 0] / matrix[2, 2], ROTATION.focal(shared))


def test_a_full_turn_closes_and_gives_lens_and_focal_length() -> None:
    rng = np.random.default_rng(5)
    rotations = panorama_rotations(13, 2 * np.pi / 13, seed=5)
    cameras = [Camera(LENS.image_size).with_guessed_focal()] * 13
    found = align(cameras, _links(rotations, rng, noise=0.1))
    assert found.model == "rotation"
    assert found.used.all()
    assert found.on_sphere
    assert found.distortion == pytest.approx(-0.2, abs=0.002)
    assert found.focal * LENS.scale == pytest.approx(554.0, rel=0.003)
    middle = np.array([(319.5, 239.5)])
    for i in range(13):
        j = (i + 1) % 13
        k = np.diag([554.0, 554.0, 1.0])
        ray = k @ rotations[j] @ rotations[i].T @ np.array([0.0, 0.0, 1.0])
        truth = LENS.distort(ray[:2] / ray[2] + LENS.center)
        assert np.linalg.norm(found.transfer(i, j, middle)[0] - truth) < 0.1


def test_a_turn_of_cropped_images_with_parallax_is_a_turn() -> None:
    """The lens's axis is off the middle of all images alike, and what neighbours share besides is no reason against."""
    rng = np.random.default_rng(5)
    rotations, cut = panorama_rotations(13, 2 * np.pi / 13, seed=5), np.array([80.0, 60.0])
    links = []
    for link in _links(rotations, rng, noise=0.2, count=400):
        kept = ((link.points1 >= cut) & (link.points2 >= cut)).all(axis=1)
        parallax = np.sin(link.points1[kept] / 40.0 + rng.uniform(0.0, 6.0, 2))
        relation = replace(link.relation, inliers=np.ones(int(kept.sum()), dtype=np.bool_))
        points = link.points1[kept] - cut, link.points2[kept] - cut + parallax
        if kept.sum() >= 20:
            links.append(Link(link.image1, link.image2, *points, relation))
    found = align([Camera((560, 420)).with_guessed_focal()] * 13, links)
    assert found.model == "rotation"
    assert found.used.all()
    axis = np.array(LENS.center) - cut
    np.testing.assert_allclose(found.cameras[0].center, axis, atol=6.0)
    assert found.focal * found.cameras[0].scale == pytest.approx(554.0, rel=0.02)


def _tilted() -> Alignment:
    """Three images, the first of which is oblique."""
    poses = np.zeros((3, 6))
    poses[:, X] = (0.0, 0.3, 0.6)
    found = aligned(scene(poses, rng=np.random.default_rng(4)), model="homography", reference=0)
    poses[0, PSI] = 1.1
    to_images = POSE.matrices(poses, POSE.shared_from_physical(np.array([0.0, 0.0, 0.26]))).matrices
    return replace(found, homographies=np.asarray(np.linalg.inv(to_images), dtype=np.float64))


def test_an_oblique_reference_gives_way_to_one_whose_horizon_no_image_crosses() -> None:
    tilted = _tilted()
    oblique = in_frame_of(tilted, 0)
    assert frontal_reference(oblique) in (1, 2)
    frontal = in_frame_of(oblique, 1)
    assert frontal_reference(frontal) == 1
    assert np.allclose(frontal.homographies[1], np.eye(3), atol=1e-9)
    for k in range(3):
        a, b = frontal.relation(k, 0), tilted.relation(k, 0)
        assert np.allclose(a / a[2, 2], b / b[2, 2], atol=1e-6)


def test_each_border_is_undistorted_once_of_any_number_of_references(monkeypatch: pytest.MonkeyPatch) -> None:
    calls, found = list[int](), _tilted()
    many = replace(
        found,
        used=np.ones(60, dtype=np.bool_),
        cameras=found.cameras * 20,
        homographies=np.tile(found.homographies, (20, 1, 1)),
    )
    undistort = Camera.undistort

    def counted(self: Camera, points: FloatArray) -> FloatArray:
        calls.append(len(points))
        return undistort(self, points)

    monkeypatch.setattr(Camera, "undistort", counted)
    assert frontal_reference(in_frame_of(many, 0)) in (1, 2)
    assert len(calls) <= 60
