"""A displacement field is a smooth surface through its nodes, in the image's own pixels."""

import numpy as np
import pytest

from rdstitch.errors import ArgumentError
from rdstitch.local_alignment import DisplacementField
from rdstitch.local_alignment.field import grid_shape, node_points

SIZE = (640, 480)
SHAPE = grid_shape(SIZE, 12)
VALUES = np.random.default_rng(1).normal(0.0, 2.0, (*SHAPE, 2))


def test_it_passes_through_its_nodes_and_is_smooth_between() -> None:
    field = DisplacementField.of(SIZE, VALUES)
    nodes = node_points(SIZE, SHAPE)
    np.testing.assert_allclose(field(nodes), field.values.reshape(-1, 2), atol=1e-9)
    # Its second differences show no kink at the nodes.
    x = np.linspace(100.0, 400.0, 3001)
    along = field(np.stack([x, np.full_like(x, 200.0)], axis=-1))
    bend = np.diff(along, n=2, axis=0) / 0.1**2
    assert np.abs(np.diff(bend, axis=0)).max() < 0.05 * np.abs(bend).max()


def test_far_outside_it_stays_as_it_is() -> None:
    field = DisplacementField.of(SIZE, VALUES)
    np.testing.assert_array_equal(field(np.array([[-500.0, 100.0]])), field(np.array([[-900.0, 100.0]])))
    assert np.isfinite(field(np.array([[1e9, 1e9], [np.nan, 3.0]]))).all()


def test_of_another_size_it_moves_the_same_content() -> None:
    field = DisplacementField.of(SIZE, VALUES)
    double = field.resized((1280, 960))
    nodes = node_points(SIZE, SHAPE)
    np.testing.assert_allclose(double(nodes * (1279 / 639, 959 / 479)), 2.0 * field(nodes), atol=1e-9)


def test_what_changes_evenly_does_so_up_to_the_border() -> None:
    matrix = np.array([[0.05, -0.02], [0.01, 0.1]])
    field = DisplacementField(SIZE, (node_points(SIZE, SHAPE) @ matrix).reshape(*SHAPE, 2))
    points = np.random.default_rng(2).uniform((0, 0), (639, 479), (500, 2))
    np.testing.assert_allclose(field(points), points @ matrix, atol=0.005)


def test_steepness_is_the_change_per_px_in_any_direction() -> None:
    x, y = node_points(SIZE, SHAPE).T
    values = np.stack([0.1 * x, np.zeros_like(y)], axis=-1).reshape(*SHAPE, 2)
    assert DisplacementField(SIZE, values).steepest == pytest.approx(0.1, abs=1e-4)
    oblique = np.stack([0.1 * (x + y), 0.1 * (x + y)], axis=-1).reshape(*SHAPE, 2)
    assert DisplacementField(SIZE, oblique).steepest == pytest.approx(0.2, abs=1e-4)
    assert DisplacementField(SIZE, values).largest == pytest.approx(63.9)


def test_what_is_no_field_is_refused() -> None:
    with pytest.raises(ArgumentError, match=r"shape \(m, n, 2\)"):
        DisplacementField(SIZE, np.zeros((3, 3)))
    with pytest.raises(ArgumentError, match="finite"):
        DisplacementField(SIZE, np.full((3, 3, 2), np.nan))
