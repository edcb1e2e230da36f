"""Rough ground is seen where rays first meet it, and the plane's own truth stays what it was."""

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.errors import ArgumentError
from rdstitch.synthetic import RELIEFS, Poses, Relief, Sequence, blank, ground, hills, pair_poses, sequence_over

LENS = Camera((320, 240), -0.2, focal=260.0)


def over(kind: str, height: float, seed: int = 1) -> Sequence:
    poses = pair_poses(LENS, 0.5)
    return sequence_over(
        lambda size: ground(size, 1, 1),
        LENS,
        poses,
        relief=lambda size: RELIEFS[kind](size, seed, height=height * 260.0),
    )


def met_by_walking(relief: Relief, position: FloatArray, height: float, foot: FloatArray) -> FloatArray:
    """Walk down the ray in steps of a hundredth of a texel's height."""
    ground_height = relief.height.astype(np.float64)
    z = np.linspace(ground_height.max(), ground_height.min(), 20000)
    x, y = (position + (foot - position) * (1.0 - z[:, None] / height)).T
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    a, b = y - i, x - j
    below = (1 - b) * ground_height[i, j] + b * ground_height[i, j + 1]
    beneath = (1 - b) * ground_height[i + 1, j] + b * ground_height[i + 1, j + 1]
    first = int(np.argmax((1 - a) * below + a * beneath >= z))
    return np.array([x[first], y[first]])


@pytest.mark.parametrize("kind", sorted(RELIEFS))
def test_a_ray_ends_where_it_first_meets_the_ground(kind: str) -> None:
    sequence = over(kind, 0.1)
    points = np.random.default_rng(2).uniform((5, 5), (314, 234), (60, 2))
    feet, found = sequence.to_plane(1, points), sequence.to_ground(1, points)
    position, height = sequence.poses.position[1], float(sequence.poses.height[1])
    expected = np.array([met_by_walking(sequence.relief, position, height, foot) for foot in feet])
    error = np.linalg.norm(found - expected, axis=1)
    # A ray that only grazes an edge may pass it between two levels.
    assert (error < 0.1).mean() > 0.95
    assert np.median(error) < 0.02
    assert np.linalg.norm(found - feet, axis=1).max() > 3.0


def test_a_wall_hides_what_is_behind_it_from_one_side_only() -> None:
    heights = np.zeros((400, 600), dtype=np.float32)
    heights[:, 280:300] = 60.0
    behind = np.array([[310.0, 200.0]])
    lens = Camera((640, 480), 0.0, focal=400.0)
    poses = Poses.of([(200.0, 200.0), (400.0, 200.0)], 400.0)
    sequence = Sequence(blank((600, 400)), lens, poses, relief=Relief(heights))
    from_left, from_right = (sequence.to_ground(k, sequence.to_image(k, behind)) for k in (0, 1))
    assert 280.0 <= from_left[0, 0] <= 300.0
    np.testing.assert_allclose(from_right, behind, atol=1e-6)


@pytest.mark.parametrize("kind", sorted(RELIEFS))
def test_points_of_the_ground_are_seen_where_rays_meet_them(kind: str) -> None:
    sequence = over(kind, 0.1)
    points = np.random.default_rng(7).uniform((5, 5), (314, 234), (200, 2))
    seen = sequence.ground_to_image(1, sequence.to_ground(1, points))
    error = np.linalg.norm(seen - points, axis=1)
    # Walls have one texel of ground for all their height.
    assert np.isfinite(error).mean() > 0.8
    assert np.nanmedian(error) < 0.05


def test_ground_as_high_as_the_camera_is_refused() -> None:
    relief = hills((100, 100), 1, height=50.0)
    with pytest.raises(ArgumentError, match="the camera only 40"):
        relief.seen_from(np.array([50.0, 50.0]), 40.0, np.zeros((3, 2)))
