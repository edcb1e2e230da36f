"""Homographies with λ, and the division model."""

from collections.abc import Callable

import numpy as np
import pytest

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.division_model import distort, horizon_radius, nearest_one_parameter, undistort, valid_radius
from rdstitch.geometry.planar_motion import PlanarMotion
from rdstitch.geometry.radial_homography import (
    RadialHomography,
    from_plane,
    measurement_whitening,
    to_plane,
    transfer,
    transfer_jacobian,
)
from rdstitch.synthetic import FisheyeLens

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


def test_cameras_are_of_whole_pixels_and_can_be_compared() -> None:
    listed = Camera([640, 480], center=[319.5, 239.5], tilt=np.zeros(2), tilt_std=[0.1, 0.1])  # type: ignore[arg-type]
    assert {listed} == {Camera((640, 480), tilt=(0.0, 0.0), tilt_std=(0.1, 0.1))}
    for size in ((640.5, 480), (640,), 640):
        with pytest.raises(ArgumentError, match="whole numbers"):
            Camera(size)  # type: ignore[arg-type]


def test_a_failed_fit_is_falsy_and_says_why() -> None:
    camera = Camera((640, 480))
    failed = RadialHomography.failed("only 2 matches", camera, camera, 7)
    assert (bool(failed), failed.reason, failed.inliers.tolist()) == (False, "only 2 matches", [False] * 7)
    assert np.isnan(failed.distortion)


def test_to_the_plane_and_back() -> None:
    camera = Camera((640, 480), distortion=-0.2, center=(330.0, 230.0))
    points = np.array([[0.0, 0.0], [320.0, 240.0], [639.0, 479.0]])
    tilted = np.array([[1.1, 0.1, 0.3], [-0.1, 0.9, -0.2], [0.3, -0.2, 1.0]])
    np.testing.assert_allclose(from_plane(camera, tilted, to_plane(camera, tilted, points)), points, atol=1e-9)
    beyond = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 2.0, 1.0]])
    assert np.isnan(to_plane(camera, beyond, [[320.0, 0.0]])).all()
    assert np.isfinite(to_plane(camera, beyond, [[320.0, 479.0]])).all()


def test_one_coefficient_is_the_closed_form_which_reaches_as_far_as_it_is_used() -> None:
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (500, 2))
    np.testing.assert_allclose(distort(points, -0.4, (0.0, 1e-300)), distort(points, -0.4), rtol=1e-12)
    assert valid_radius(0.0) == np.inf
    assert valid_radius(-0.25) == pytest.approx(2.0)
    assert valid_radius(0.25) == pytest.approx(2.0)


@pytest.mark.parametrize("higher", [(0.02, 0.01), (0.3, 0.2), (-0.9, 0.3), (-0.2,)])
def test_the_root_is_exact_and_the_same_alone_as_among_others(higher: tuple[float, ...]) -> None:
    straight = np.random.default_rng(0).uniform(-3.0, 3.0, size=(500, 2))
    seen = distort(straight, -0.2, higher)
    finite = np.isfinite(seen).all(axis=1)
    assert finite.any()
    np.testing.assert_allclose(undistort(seen[finite], -0.2, higher), straight[finite], rtol=1e-11, atol=1e-11)
    alone = np.stack([distort(point, -0.2, higher) for point in straight])
    np.testing.assert_allclose(alone, seen, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("coefficients", [(0.3, -0.9, 0.2), (-0.4, 0.5, -0.6), (0.1, 0.1, 0.1), (-0.6, -0.1, 0.8)])
def test_what_lies_beyond_the_domain_is_masked_and_never_folded(coefficients: tuple[float, float, float]) -> None:
    distortion, *higher = coefficients
    limit = valid_radius(distortion, tuple(higher))
    radii = np.linspace(1e-3, 1.5 * limit, 400)
    straight = undistort(np.column_stack([radii, np.zeros_like(radii)]), distortion, higher)[:, 0]
    assert np.isfinite(straight[radii < limit]).all()
    assert np.isnan(straight[radii > limit]).all()
    seen = straight[np.isfinite(straight)]
    assert (np.diff(seen) > 0.0).all()
    back = distort(np.column_stack([seen, np.zeros_like(seen)]), distortion, higher)[:, 0]
    np.testing.assert_allclose(back, radii[: len(seen)], atol=1e-7)
    assert not (distort([[x, 0.0] for x in np.geomspace(1e-3, 1e6, 300)], distortion, higher) > limit).any()


@pytest.mark.parametrize(
    ("coefficients", "told"),
    [
        *((folding, "folds") for folding in ((1.2, 0.0, 0.0), (-0.4, 0.9, 0.0), (0.1, 0.1, 0.9))),
        ((-30.0, 0.0, 0.0), "next to nothing"),
        # A damaged camera file holds them; what they are multiplied by would be infinite.
        *((endless, "") for endless in ((0.0, 1e308, 1e308), (0.0, 0.0, 1e308), (-1e308, 1e308, 1e308))),
    ],
)
def test_a_camera_that_folds_in_its_image_is_refused(coefficients: tuple[float, float, float], told: str) -> None:
    with pytest.raises(ArgumentError, match=told or None):
        Camera((640, 480), coefficients[0], coefficients[1], distortion3=coefficients[2])


@pytest.mark.parametrize("coefficients", [(-1.6, 0.0, 0.0), (-3.0, 2.2, 0.0), (-1.2, -0.5, -0.4)])
def test_what_a_fisheye_sees_beyond_the_horizon_is_masked(coefficients: tuple[float, float, float]) -> None:
    camera = Camera((640, 480), coefficients[0], coefficients[1], (330.0, 235.0), distortion3=coefficients[2])
    assert camera.sees_beyond_horizon
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    points = np.column_stack([u.ravel(), v.ravel()])
    straight, radius = camera.undistort(points), np.linalg.norm(camera.normalize(points), axis=1)
    horizon = horizon_radius(camera.distortion, camera.higher)
    seen = np.isfinite(straight).all(axis=1)
    np.testing.assert_array_equal(seen, radius < horizon)
    np.testing.assert_allclose(camera.distort(straight[seen]), points[seen], atol=1e-6)
    # What is drawn ends before, where the lens stretches too much, and nowhere beyond the image.
    outline = camera.outline(16)
    border = np.linalg.norm(camera.normalize(outline), axis=1)
    assert (border < horizon).all()
    assert np.isfinite(camera.undistort(outline)).all()
    inner, outer = (np.linalg.norm(camera.undistort(camera.denormalize([[r, 0.0]])) - camera.center) for r in
                    (border.max() - 1e-3, border.max()))  # fmt: skip
    assert 15.0 < (outer - inner) / (1e-3 * camera.scale) < 21.0
    assert not Camera((640, 480), -0.9).sees_beyond_horizon


def test_nearest_lambda_is_what_a_fit_of_measured_points_gives() -> None:
    lens = Camera((640, 480), -0.45, -0.06, (330.0, 230.0), distortion3=-0.01)
    nearest, rms, largest = lens.one_parameter_fit()
    radii = np.sqrt(lens.squared_radii())
    assert nearest_one_parameter(radii**2, nearest)[0] == pytest.approx(nearest, abs=1e-12)

    def misfit(distortion: float, scale: float) -> float:
        straight = undistort(np.column_stack([radii, 0.0 * radii]), lens.distortion, lens.higher) * scale
        return float(np.mean((distort(straight, distortion)[:, 0] - radii) ** 2))

    scale = 1.0 / nearest_one_parameter(radii**2, lens.distortion, lens.higher)[1]
    best = misfit(nearest, scale)
    assert rms == pytest.approx(np.sqrt(best) * lens.scale, rel=1e-6)
    assert rms < largest
    for distortion, factor in ((nearest + 0.002, scale), (nearest - 0.002, scale), (nearest, 1.002 * scale)):
        assert misfit(distortion, factor) > best


def test_three_coefficients_describe_an_equidistant_fisheye() -> None:
    # r cot r = 1 - r²/3 - r⁴/45 - 2 r⁶/945 - …, with r the angle to the axis.
    half = np.radians(60.0)
    fisheye = FisheyeLens((640, 480), 400.0 / half)
    lens = Camera((640, 480), -(half**2) / 3, -(half**4) / 45, distortion3=-2.0 * half**6 / 945)
    points = np.random.default_rng(0).uniform((0, 0), (639, 479), (300, 2))
    assert np.linalg.norm(lens.distort(fisheye.undistort(points)) - points, axis=1).max() < 0.1


def test_no_motion_is_that_of_a_level_camera() -> None:
    found = PlanarMotion.from_homography(np.eye(3))
    assert np.abs([*found.tilt, found.yaw, *found.translation]).max() < 1e-9
