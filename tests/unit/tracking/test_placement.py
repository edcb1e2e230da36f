"""Poses from homographies, and similarities of the plane."""

import math

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.planar_motion import rotation_from_tilt
from rdstitch.tracking import CameraPose, Placement, PlaneSimilarity


def _placed(x: float, y: float, yaw: float, height: float, tilt: tuple[float, float] = (0.1, -0.2)) -> Placement:
    """``P = diag(f, f, 1) R Rz(φ) diag(1, 1, h) T(t)``, up to scale."""
    c, s, f = math.cos(yaw), math.sin(yaw), 1.3
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    rows = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [0.0, 0.0, height]])
    projection = np.diag([f, f, 1.0]) @ rotation_from_tilt(tilt) @ turn @ rows
    return Placement(Camera((640, 480), -0.2), 3.0 * np.linalg.inv(projection), f)


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0, 1.0), (1.5, -2.0, 2.5, 0.8), (-3.0, 0.2, -3.0, 1.4)])
def test_the_pose_of_a_homography_is_the_one_it_was_made_of(pose: tuple[float, float, float, float]) -> None:
    found = _placed(*pose).pose
    np.testing.assert_allclose([found.x, found.y, found.yaw, found.height], pose, atol=1e-9)


def test_without_focal_length_or_homography_there_is_no_pose() -> None:
    placed = _placed(0.0, 0.0, 0.0, 1.0)
    assert Placement(placed.camera, placed.homography, None).pose is None
    assert Placement(placed.camera, np.full((3, 3), np.nan), 1.0).pose is None


def test_a_similarity_moves_a_placement_and_its_pose_alike() -> None:
    first, second = _placed(1.0, 2.0, 0.3, 0.9), _placed(2.0, 1.0, 1.1, 1.2)
    move = PlaneSimilarity.to_origin(first.pose)
    origin, other = move.applied(first).pose, move.applied(second).pose
    np.testing.assert_allclose([origin.x, origin.y, origin.yaw, origin.height], [0.0, 0.0, 0.0, 1.0], atol=1e-9)
    turned = np.array([[math.cos(0.3), -math.sin(0.3)], [math.sin(0.3), math.cos(0.3)]]) @ [1.0, -1.0] / 0.9
    np.testing.assert_allclose([other.x, other.y, other.yaw, other.height], [*turned, 0.8, 1.2 / 0.9], atol=1e-9)


def test_planes_are_brought_together_by_the_images_that_both_have() -> None:
    placed = [_placed(0.0, 0.0, 0.2, 1.0), _placed(1.0, 0.5, -0.4, 1.1)]
    move = PlaneSimilarity(0.7 * complex(math.cos(1.0), math.sin(1.0)), 2.0 - 3.0j)
    found = PlaneSimilarity.between(placed, [move.applied(one) for one in placed])
    assert found.turn == pytest.approx(move.turn)
    assert found.shift == pytest.approx(move.shift)


def test_a_fit_may_keep_the_size() -> None:
    points = np.random.default_rng(0).normal(size=(20, 2))
    kept = PlaneSimilarity.fitted(points, 2.0 * points + 1.0, keep_size=True)
    assert abs(kept.turn) == pytest.approx(1.0)
    assert PlaneSimilarity.fitted(points, 2.0 * points + 1.0).turn == pytest.approx(2.0)
    assert CameraPose(0.0, 0.0, 0.0, 1.0) == CameraPose(0.0, 0.0, 0.0, 1.0)
