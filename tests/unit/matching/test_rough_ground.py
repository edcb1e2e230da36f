"""Over rough ground the inliers of a pair are not those of one plane."""

from dataclasses import replace

import numpy as np
import pytest

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.camera import Camera
from rdstitch.features import Correspondences
from rdstitch.matching.feature_store import StoredMatches
from rdstitch.matching.rough_ground import over_rough_ground
from rdstitch.matching.two_view import PairRegistration
from rdstitch.radial_homography import RadialHomography

CAMERA = Camera((640, 480), -0.2)
POINTS = np.random.default_rng(0).uniform((5.0, 5.0), (634.0, 474.0), (300, 2))
RIGHT = np.arange(300) < 240  # the others are matched with anything
PLANE = POINTS[:, 0] < 250.0


def _pair(parallax: FloatArray, plane: BoolArray = PLANE) -> PairRegistration:
    """A pair whose plane has no motion, of which ``plane`` are inliers."""
    points2 = POINTS + np.column_stack([parallax, np.zeros(300)])
    points2[~RIGHT] = np.random.default_rng(1).uniform((0.0, 0.0), (639.0, 479.0), (60, 2))
    index = np.column_stack([np.arange(300)] * 2)
    matches = Correspondences(index, POINTS, points2, np.zeros(300))
    relation = RadialHomography(np.eye(3), CAMERA, CAMERA, plane & RIGHT, distortion_std=0.01)
    return PairRegistration(0, 1, StoredMatches.of(matches), relation)


def test_the_other_flank_of_a_valley_belongs_to_the_ground() -> None:
    pair = _pair(np.maximum(POINTS[:, 0] - 250.0, 0.0) * 0.08)
    failed = replace(pair, image2=2, relation=RadialHomography.failed("little in common", CAMERA, CAMERA, 300))
    rough, same = over_rough_ground([pair, failed], 3.0)
    assert same is failed
    relation = rough.relation
    assert relation.inliers[RIGHT].mean() > 0.98
    assert relation.inliers[~RIGHT].mean() < 0.1
    matched = rough.correspondences
    errors = np.linalg.norm(relation.transfer(matched.points1) - matched.points2, axis=1)[RIGHT]
    assert np.sqrt(np.mean(errors**2)) < 8.0  # 31 pixels at the far side, by the plane of the near one
    assert (relation.distortion, relation.distortion_std) == (-0.2, 0.01)
    (again,) = over_rough_ground([rough], 3.0)
    assert again is rough


@pytest.mark.parametrize("step", [0.0, 25.0])
def test_flat_ground_and_what_moves_on_it_stay_as_they_are(step: float) -> None:
    """A vehicle over half of what both show ends with a step."""
    pair = _pair(np.where(PLANE, 0.0, step), PLANE if step else RIGHT)
    (found,) = over_rough_ground([pair], 3.0)
    assert found is pair
