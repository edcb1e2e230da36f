"""Nearest points against all distances."""

import numpy as np
import pytest

from rdstitch.geometry.nearest_points import nearest_points


@pytest.mark.parametrize(("points", "queries", "dimensions"), [(1, 3, 2), (40, 7, 2), (900, 50, 3)])
def test_the_nearest_points_are_those_of_all_distances(points: int, queries: int, dimensions: int) -> None:
    rng = np.random.default_rng(points)
    # Metres of a map projection: far from 0.
    places, asked = (5e6 + 100.0 * rng.random((count, dimensions)) for count in (points, queries))
    distances, indices = nearest_points(places, asked, 4)
    expected = np.sort(np.linalg.norm(asked[:, None] - places, axis=2), axis=1)[:, :4]
    np.testing.assert_allclose(distances, expected, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(asked[:, None] - places[indices], axis=2), expected, atol=1e-4)
