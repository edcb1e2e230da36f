"""Crossings of edges: found at any perspective, to a fraction of a pixel; nothing else is."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features.crossings import find_crossings
from rdstitch.features.prepared_image import View, prepare

_SQUARES, _SUBPIXELS = 8, 6


def _oblique_board(tilt: float, size: tuple[int, int] = (400, 300)) -> tuple[NDArray[np.uint8], FloatArray]:
    """A board of 8 x 8 squares of 30 pixels in its middle, and its inner corners, pixels."""
    to_board = np.array([[0.05 / 1.5, 0.004, 0.0], [-0.006, 0.05 / 1.5, 0.0], [tilt * 1e-3, tilt * 5e-4, 1.0]])
    middle = np.array([199.3, 150.2])
    u, v = ((np.arange(side * _SUBPIXELS) + 0.5) / _SUBPIXELS - 0.5 for side in size)
    points = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2) - middle
    seen = np.column_stack([points, np.ones(len(points))]) @ to_board.T
    x, y = (seen[:, :2] / seen[:, 2:] + _SQUARES / 2).T
    inside = (x > 0) & (x < _SQUARES) & (y > 0) & (y < _SQUARES)
    grey = np.where(inside, 40.0 + 160.0 * ((np.floor(x) + np.floor(y)) % 2), 120.0)
    grey = grey.reshape(size[1], _SUBPIXELS, size[0], _SUBPIXELS).mean(axis=(1, 3))
    grey = grey + np.random.default_rng(0).normal(0.0, 2.0, grey.shape)
    inner = np.stack(np.meshgrid(*[np.arange(1, _SQUARES) - _SQUARES / 2] * 2), axis=-1).reshape(-1, 2)
    corners = np.column_stack([inner, np.ones(len(inner))]) @ np.linalg.inv(to_board).T
    return np.rint(grey).astype(np.uint8), corners[:, :2] / corners[:, 2:] + middle


@pytest.mark.parametrize("tilt", [0.0, 2.0])
def test_the_corners_of_a_board_are_found(tilt: float) -> None:
    grey, corners = _oblique_board(tilt)
    found = find_crossings(prepare(View(grey), None))
    distance = np.linalg.norm(found[:, None] - corners, axis=2).min(axis=0)
    assert distance.max() < 0.15
    assert np.sqrt(np.mean(distance**2)) < 0.05
    assert len(found) < 2 * len(corners)


def test_what_is_masked_has_none() -> None:
    grey, corners = _oblique_board(0.0)
    mask = np.ones(grey.shape, dtype=np.bool_)
    mask[:, :200] = False
    found = find_crossings(prepare(View(grey, mask), None))
    assert len(found) >= np.sum(corners[:, 0] > 206)
    assert found[:, 0].min() > 200


def test_an_image_of_nothing_has_none() -> None:
    assert find_crossings(prepare(View(np.full((60, 80), 90, dtype=np.uint8)), None)).shape == (0, 2)
