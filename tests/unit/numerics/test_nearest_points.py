"""Nearest points are exact, and none of no points."""

import numpy as np
import pytest

from rdstitch.numerics.nearest_points import nearest_points, separate_neighbours


@pytest.mark.parametrize(("points", "queries", "dimensions"), [(1, 3, 2), (40, 7, 2), (900, 50, 3)])
def test_the_nearest_points_are_those_of_all_distances(points: int, queries: int, dimensions: int) -> None:
    rng = np.random.default_rng(points)
    # Metres of a map projection: far from 0.
    places, asked = (5e6 + 100.0 * rng.random((count, dimensions)) for count in (points, queries))
    distances, indices = nearest_points(places, asked, 4)
    expected = np.sort(np.linalg.norm(asked[:, None] - places, axis=2), axis=1)[:, :4]
    np.testing.assert_allclose(distances, expected, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(asked[:, None] - places[indices], axis=2), expected, atol=1e-4)


@pytest.mark.parametrize(("twins", "found"), [(0, True), (1, True), (2, True), (3, False)])
def test_a_feature_that_is_found_several_times_is_no_neighbour_of_itself(twins: int, found: bool) -> None:
    places = np.random.default_rng(0).uniform(-0.6, 0.6, (100, 2))
    several = np.concatenate([places + 1e-3 * k * np.array([1.0, -1.0]) for k in range(twins + 1)])
    distance, index = separate_neighbours(several)
    assert (distance > 0.005).all() == found
    assert (index % 100 != np.arange(len(several)) % 100).all() == found
    assert separate_neighbours(places[:1])[1].tolist() == [0]


def test_of_no_points_there_is_none_and_points_must_be_finite() -> None:
    none, some = np.empty((0, 2)), np.ones((3, 2))
    assert [len(each) for each in separate_neighbours(none)] == [0, 0]
    assert nearest_points(some, none, 2)[1].shape == (0, 2)
    assert nearest_points(none, some, 2)[1].shape == (3, 0)
    with pytest.raises(ValueError, match="not finite"):
        nearest_points(np.array([[0.0, np.nan]]), some, 1)
