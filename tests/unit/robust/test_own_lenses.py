"""What one pair of images sees of two lenses."""

from dataclasses import replace

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.robust import estimate_radial_homography
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.own_lenses import OwnLenses, own_lenses
from tests.correspondences import correspondences

_THRESHOLD = 3.0


def _seen(first: Camera | None, second: Camera | None, seed: int, motion: str = "similarity") -> OwnLenses:
    """What own lenses come to where images of one lens were taken with others instead."""
    matches = correspondences(400, seed=seed, motion=motion, noise=0.3)
    lens = matches.truth.camera

    def taken(points: FloatArray, other: Camera | None) -> FloatArray:
        return points if other is None else other.distort(lens.undistort(points))

    points1, points2 = taken(matches.points1, first), taken(matches.points2, second)
    kept = np.isfinite(points1).all(axis=1) & np.isfinite(points2).all(axis=1)
    points1, points2 = points1[kept], points2[kept]
    relation = estimate_radial_homography(points1, points2, lens.image_size)
    data = Measurements.from_pixels(points1, points2, relation.camera, relation.camera2)
    return own_lenses([relation], data, _THRESHOLD)[0]


def _difference(found: OwnLenses) -> tuple[float, float]:
    """λ of the second image less that of the first, and its standard deviation."""
    sign = np.array([-1.0, 1.0])
    return float(sign @ found.distortion), float(np.sqrt(sign @ found.covariance @ sign))


@pytest.mark.parametrize("motion", ["rigid", "homography"])
@pytest.mark.parametrize("other", [-0.15, -0.05])
def test_two_lenses_are_seen_for_what_they_are(other: float, motion: str) -> None:
    for seed in range(4):
        found = _seen(None, Camera((1000, 800), other), seed, motion)
        difference, std = _difference(found)
        assert abs(difference) > 10.0 * std
        np.testing.assert_allclose(difference, other + 0.25, atol=min(0.02, 5.0 * std))
        missed = np.abs(found.distortion - (-0.25, other)) / np.sqrt(np.diag(found.covariance))
        assert missed.max() < 5.0


@pytest.mark.parametrize(
    "other", [None, Camera((1000, 800), -0.25, center=(525.0, 385.0)), Camera((1000, 800), -0.25, distortion2=0.05)]
)
def test_one_lens_is_one_wherever_its_centre_is(other: Camera | None) -> None:
    for seed in range(6):
        difference, std = _difference(_seen(other, other, seed))
        assert abs(difference) < 5.0 * std


def test_rotation_about_the_axis_does_not_show_the_lens() -> None:
    rng = np.random.default_rng(3)
    lens = Camera((640, 480), -0.2)
    points1 = rng.uniform((0, 0), (639, 479), (300, 2))
    c, s = np.cos(0.3), np.sin(0.3)
    points2 = (points1 - lens.center) @ np.array([[c, s], [-s, c]]) + lens.center + 0.3 * rng.standard_normal((300, 2))
    relation = estimate_radial_homography(points1, points2, lens.image_size)
    data = Measurements.from_pixels(points1, points2, lens, lens)
    found = own_lenses([replace(relation, camera=lens, camera2=lens)], data, _THRESHOLD)[0]
    assert np.sqrt(np.diag(found.covariance)).min() > 0.1
