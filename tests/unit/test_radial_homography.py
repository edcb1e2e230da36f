"""Transfer and its derivatives, against finite differences."""

from collections.abc import Callable

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.planar_motion import PlanarMotion
from rdstitch.radial_homography import (
    RadialHomography,
    from_plane,
    measurement_whitening,
    to_plane,
    transfer,
    transfer_jacobian,
)

H = PlanarMotion((0.1, -0.2), 0.1, (0.2, -0.1), 1.1).homography() + 0.02 * np.arange(9).reshape(3, 3)
POINTS = np.random.default_rng(1).uniform(-0.5, 0.5, (8, 2))
STEP = 1e-6


def difference(function: Callable[[float], FloatArray]) -> FloatArray:
    return (function(STEP) - function(-STEP)) / (2 * STEP)


@pytest.mark.parametrize(
    ("lam", "higher"),
    [(-0.3, ()), (0.0, ()), (0.2, (-0.1, 0.0)), (-0.3, (0.05, 0.0)), (-0.4, (0.05, -0.1)), (0.0, (0.0, 0.1))],
)
def test_derivatives_match_finite_differences(lam: float, higher: tuple[float, ...]) -> None:
    found = transfer_jacobian(H, lam, POINTS, higher)
    np.testing.assert_allclose(found.points, transfer(H, lam, POINTS, higher), atol=1e-14)
    for entry in range(9):
        unit = np.eye(9)[entry].reshape(3, 3)
        expected = difference(lambda e, u=unit: transfer(H + e * u, lam, POINTS, higher))  # type: ignore[misc]
        np.testing.assert_allclose(found.by_homography[:, :, entry], expected, atol=1e-8)
    by_lens = found.by_lens(np.ones(5, dtype=np.bool_)).T
    np.testing.assert_array_equal(found.by_lens(np.arange(5) == 3).T, by_lens[:, 3:4])
    by_lambda = difference(lambda e: transfer(H, lam + e, POINTS, higher))
    np.testing.assert_allclose(by_lens[:, 0], by_lambda, atol=1e-8)
    if higher:
        by_mu = difference(lambda e: transfer(H, lam, POINTS, (higher[0] + e, higher[1])))
        by_nu = difference(lambda e: transfer(H, lam, POINTS, (higher[0], higher[1] + e)))
        np.testing.assert_allclose(by_lens[:, 1], by_mu, atol=1e-8)
        np.testing.assert_allclose(by_lens[:, 2], by_nu, atol=1e-8)
    for axis in range(2):
        shift = np.eye(2)[axis]
        by_centre = difference(lambda e, s=shift: transfer(H, lam, POINTS - e * s, higher) + e * s)  # type: ignore[misc]
        np.testing.assert_allclose(by_lens[:, 3 + axis], by_centre, atol=1e-8)
        by_point = difference(lambda e, s=shift: transfer(H, lam, POINTS + e * s, higher))  # type: ignore[misc]
        np.testing.assert_allclose(found.by_point[:, :, axis], by_point, atol=1e-8)


def test_a_point_behind_the_camera_is_nan() -> None:
    horizon = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [4.0, 0.0, 1.0]])
    moved = transfer(horizon, -0.1, [[0.1, 0.0], [-0.4, 0.0]])
    assert np.isfinite(moved[0]).all()
    assert np.isnan(moved[1]).all()
    assert np.isnan(transfer_jacobian(horizon, -0.1, np.array([[-0.4, 0.0]])).by_homography).all()


def test_whitening_has_the_covariance_of_noise_in_both_images() -> None:
    jacobian = np.random.default_rng(0).normal(size=(20, 2, 2))
    w = measurement_whitening(jacobian)
    covariance = (np.eye(2) + jacobian @ np.swapaxes(jacobian, 1, 2)) / 2
    np.testing.assert_allclose(w @ covariance @ np.swapaxes(w, 1, 2), np.broadcast_to(np.eye(2), w.shape), atol=1e-12)


def test_pixels_and_normalized_coordinates_agree() -> None:
    camera = Camera((640, 480), -0.25)
    relation = RadialHomography(H, camera, camera.resized((320, 240)), np.ones(1, dtype=np.bool_))
    points = np.array([[100.0, 80.0], [400.0, 300.0]])
    lifted = np.column_stack([camera.undistort(points), np.ones(2)]) @ relation.homography_px.T
    expected = relation.camera2.distort(lifted[:, :2] / lifted[:, 2:])
    np.testing.assert_allclose(relation.transfer(points), expected, atol=1e-9)


def test_a_failed_fit_is_falsy_and_says_why() -> None:
    camera = Camera((640, 480))
    failed = RadialHomography.failed("only 2 matches", camera, camera, 7)
    assert not failed
    assert failed.reason == "only 2 matches"
    assert np.isnan(failed.distortion)
    assert failed.inliers.shape == (7,)
    assert not failed.inliers.any()


def test_to_the_plane_and_back() -> None:
    camera = Camera((640, 480), distortion=-0.2, center=(330.0, 230.0))
    points = np.array([[0.0, 0.0], [320.0, 240.0], [639.0, 479.0]])
    tilted = np.array([[1.1, 0.1, 0.3], [-0.1, 0.9, -0.2], [0.3, -0.2, 1.0]])
    np.testing.assert_allclose(from_plane(camera, tilted, to_plane(camera, tilted, points)), points, atol=1e-9)
    beyond = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 2.0, 1.0]])
    assert np.isnan(to_plane(camera, beyond, [[320.0, 0.0]])).all()
    assert np.isfinite(to_plane(camera, beyond, [[320.0, 479.0]])).all()
