"""Matches of many pairs as one array."""

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.errors import ArgumentError
from rdstitch.robust.measurements import Measurements, checked_matches, padded_length

SMALL, LARGE = Camera((300, 400)), Camera((600, 800))


def _two_pairs() -> Measurements:
    rng = np.random.default_rng(0)
    points = [(rng.uniform(0, 299, (n, 2)), rng.uniform(0, 299, (n, 2))) for n in (20, 9)]
    return Measurements.of_pairs(points, [(SMALL, LARGE), (LARGE, SMALL)])


def test_points_are_in_half_diagonals_of_their_own_image() -> None:
    data = _two_pairs()
    assert data.x1.shape == (2, 2, padded_length(20))
    assert data.count.tolist() == [20, 9]
    assert data.present.sum(axis=1).tolist() == [20, 9]
    assert data.present[1, :9].all()
    assert data.px.tolist() == [500.0, 250.0]
    assert data.px_ratio.tolist() == [2.0, 0.5]
    one = Measurements.from_pixels([[149.5, 199.5]], [[299.5 + 500.0, 399.5]], SMALL, LARGE)
    assert (one.x1[0, :, 0].tolist(), one.x2[0, :, 0].tolist()) == ([0.0, 0.0], [1.0, 0.0])
    np.testing.assert_allclose(data.radius2, (data.x1**2).sum(axis=1))


def test_matches_that_are_left_out_stay_out() -> None:
    data = _two_pairs()
    few = data.only(np.arange(data.present.shape[1])[None] < np.array([[5], [30]]))
    assert few.present.sum(axis=1).tolist() == [5, 9]
    # What was left out before is not let in again.
    assert few.only(np.ones_like(few.present)).present.sum(axis=1).tolist() == [5, 9]


@pytest.mark.parametrize(
    ("points1", "points2", "says"),
    [
        (np.zeros((3, 3)), np.zeros((3, 2)), "points1 must have shape"),
        (np.zeros((3, 2)), np.zeros(6), "points2 must have shape"),
        (np.zeros((3, 2)), np.full((3, 2), np.nan), "points2 has values that are not finite"),
        (np.zeros((3, 2)), np.zeros((4, 2)), "differ in length: 3 and 4"),
    ],
)
def test_wrong_matches_are_refused(points1: np.ndarray, points2: np.ndarray, says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        checked_matches(points1, points2)
