"""Instances satisfy the equations that they are to be solved by."""

import numpy as np
import pytest

from rdstitch.radial_homography import transfer
from rdstitch.solvers.solutions import Solutions
from tests.correspondences import correspondences
from tests.instances import HALF_SIZE, planar_instances


def test_points_of_planar_instances_obey_homography_and_motion() -> None:
    instances = planar_instances(200, 4, seed=1, height=(0.75, 1.3))
    for k in range(0, 200, 7):
        h, lam = instances.homography[k], instances.distortion[k]
        np.testing.assert_allclose(transfer(h, lam, instances.x1[k]), instances.x2[k], atol=1e-12)
        np.testing.assert_allclose(instances.motion(k).homography(), h, atol=1e-12)
    for x in (instances.x1, instances.x2):
        assert (np.abs(x) <= HALF_SIZE).all()
    assert (np.abs(instances.tilt) <= 0.3).all()
    assert np.ptp(instances.yaw) > 5.0
    assert (instances.distortion.min() < -0.65) & (instances.distortion.max() > -0.05)


def test_seed_decides_and_noise_has_the_requested_size() -> None:
    clean, again = planar_instances(2000, 3, seed=4), planar_instances(2000, 3, seed=4)
    np.testing.assert_array_equal(clean.x2, again.x2)
    noisy = planar_instances(2000, 3, seed=4, noise=1e-3)
    np.testing.assert_array_equal(clean.homography, noisy.homography)
    assert (noisy.x1 - clean.x1).std() == pytest.approx(1e-3, rel=0.05)
    assert (noisy.x2 - clean.x2).std() == pytest.approx(1e-3, rel=0.05)
    assert (planar_instances(2000, 3, seed=5).x1 != clean.x1).any()


def test_best_errors_picks_the_nearest_solution_of_each_sample() -> None:
    instances = planar_instances(3, 2, seed=6)
    solutions = Solutions(
        sample=np.array([0, 0, 2]),
        homography=np.stack([np.eye(3), -2.0 * instances.homography[0], instances.homography[2]]),
        distortion=instances.distortion[[0, 0, 2]] + (0.2, -0.1, 1e-9),
    )
    distortion, homography = instances.best_errors(solutions)
    np.testing.assert_allclose(distortion, [0.1, np.inf, 1e-9], atol=1e-15)
    np.testing.assert_allclose(homography, [0.0, np.inf, 0.0], atol=1e-14)
    assert np.isinf(instances.best_errors(Solutions.empty())[0]).all()


@pytest.mark.parametrize("motion", ["rigid", "similarity", "homography"])
def test_correspondences_are_as_requested(motion: str) -> None:
    clean = correspondences(300, seed=7, motion=motion, noise=0.0, outliers=0.4)
    error = np.linalg.norm(clean.truth.transfer(clean.points1) - clean.points2, axis=1)
    assert clean.inliers.sum() == 180
    assert error[clean.inliers].max() < 1e-9
    assert np.nanmedian(error[~clean.inliers]) > 50.0
    for points in (clean.points1, clean.points2):
        assert ((points >= 0.0) & (points <= (999, 799))).all()
    assert np.median(clean.quality[clean.inliers]) > np.median(clean.quality[~clean.inliers])
    assert (clean.truth.motion is None) == (motion == "homography")
    noisy = correspondences(300, seed=7, motion=motion, noise=0.7, outliers=0.4)
    assert (noisy.points1 - clean.points1)[clean.inliers].std() == pytest.approx(0.7, rel=0.15)
