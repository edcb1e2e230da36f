"""Vanishing points and rectangles."""

import numpy as np
import pytest

from examples.worlds.turns import camera_rotations
from rdstitch.alignment.frames.vanishing_points import Edges, Focal, nearest_axis, of_edges, of_rectangle, of_scene
from rdstitch.arrays import FloatArray

FOCAL, PIXEL = 1.3, 1.0 / 600.0
WALL = np.array([[-1.0, -0.7, 0.0], [1.0, -0.7, 0.0], [1.0, 0.7, 0.0], [-1.0, 0.7, 0.0]])
TURN = camera_rotations(0.4, -0.3, 0.1)[0]


def _seen(points: FloatArray, turn: FloatArray = TURN) -> FloatArray:
    """Points of a wall in an image, homogeneous, half diagonals."""
    there = points @ turn.T + (0.0, 0.0, 4.0)
    seen: FloatArray = there / there[..., 2:] * (FOCAL, FOCAL, 1.0)
    return seen


def _joints(rng: np.random.Generator, count: int, turn: FloatArray = TURN) -> FloatArray:
    """Ends (count, 2, 3) of horizontal and vertical edges of the wall, and as many of no direction."""
    start = np.column_stack([rng.uniform(-1.0, 1.0, (count, 2)), np.zeros(count)])
    ends = np.stack([start, start], axis=1)
    ends[np.arange(count), 1, rng.integers(0, 2, count)] += rng.uniform(0.1, 0.6, count)
    both = np.concatenate([_seen(ends, turn), _anything(rng, count)])
    noise: FloatArray = rng.normal(0.0, 0.3 * PIXEL, both.shape) * (1.0, 1.0, 0.0)
    return both + noise


def _anything(rng: np.random.Generator, count: int) -> FloatArray:
    angle, start = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(-0.6, 0.6, (count, 2))
    ends = np.stack([start, start + 0.15 * np.column_stack([np.cos(angle), np.sin(angle)])], axis=1)
    return np.concatenate([ends, np.ones((count, 2, 1))], axis=2)


@pytest.mark.parametrize("focal", [Focal(FOCAL, 0.01), Focal(1.3 * FOCAL, 0.3)])
def test_the_shape_of_a_rectangle_and_its_focal_length(focal: Focal) -> None:
    upright, aspect, error = of_rectangle(_seen(WALL)[:, :2], focal, 0.01 * PIXEL)
    assert aspect == pytest.approx(2.0 / 1.4, rel=1e-3)
    assert 1e-5 < error < 1e-3
    assert upright.focal.value == pytest.approx(FOCAL, rel=1e-2)
    np.testing.assert_allclose(upright.axes, TURN[:, :2].T, atol=2e-3)


def test_a_rectangle_seen_squarely_says_nothing_of_the_focal_length() -> None:
    corners = _seen(WALL, np.eye(3))[:, :2]
    upright, aspect, error = of_rectangle(corners, Focal(2.0, 0.3), PIXEL)
    assert upright.focal == Focal(2.0, 0.3)
    assert aspect == pytest.approx(2.0 / 1.4)
    assert error == pytest.approx(0.006, abs=0.003)  # of corners alone


@pytest.mark.parametrize("focal", [Focal(FOCAL, 0.01), Focal(1.3 * FOCAL, 0.3)])
def test_edges_of_a_wall_among_others(focal: Focal) -> None:
    edges = Edges.between(_joints(np.random.default_rng(0), 250), 0.3 * PIXEL)
    found = of_scene(edges, np.eye(3), focal, depth=False)
    upright, across, down = found
    assert 150 < across + down < 280
    assert upright.focal.value == pytest.approx(FOCAL, rel=0.02)
    off = np.degrees(np.arccos(np.clip((upright.axes * TURN[:, :2].T).sum(axis=1), -1.0, 1.0)))
    assert off.max() < (0.5 if focal.log_std < 0.1 else 1.5)


def test_edges_all_around_a_camera() -> None:
    """Three directions of a room, some of them behind: a rotation about its centre."""
    rng = np.random.default_rng(2)
    turn = camera_rotations(0.3, 0.2, -0.15)[0]
    start = rng.normal(size=(300, 3))
    ends = np.stack([start, start + np.eye(3)[rng.integers(0, 3, 300)] * 0.4], axis=1) @ turn.T
    edges = Edges.between(ends + rng.normal(0.0, 1e-4, ends.shape), 1e-4, on_sphere=True)
    found = of_scene(edges, np.eye(3), Focal(1.0), depth=True)
    upright = found[0]
    np.testing.assert_allclose(upright.axes, turn[:, :2].T, atol=1e-3)
    assert upright.focal.value == 1.0


@pytest.mark.parametrize("seed", range(8))
def test_edges_without_a_direction_are_none(seed: int) -> None:
    edges = Edges.between(_anything(np.random.default_rng(seed), 400), 0.3 * PIXEL)
    assert of_scene(edges, np.eye(3), Focal(FOCAL, 0.3), depth=False) is None
    assert of_scene(edges.chosen(np.arange(0)), np.eye(3), Focal(FOCAL), depth=False) is None


def test_few_lines_turn_as_little_as_will_do() -> None:
    """One vertical line that leans: a roll alone, about as much as it leans."""
    ends = np.array([[(0.0, -0.3, 1.0), (0.03, 0.3, 1.0)]])
    edges = Edges.between(ends, PIXEL)
    upright = of_edges(edges, nearest_axis(edges, np.eye(3)[:2], FOCAL), np.eye(3), Focal(FOCAL, 0.01), FOCAL)
    assert edges.angles(upright.axes, FOCAL)[1, 0] < 1e-6
    assert np.degrees(np.arctan2(upright.axes[0, 1], upright.axes[0, 0])) == pytest.approx(-2.86, abs=0.2)
    assert abs(upright.axes[:, 2]).max() < 0.02
