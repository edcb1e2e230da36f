"""The division model with several coefficients: its domain, its inverse, and the nearest λ."""

import numpy as np
import pytest

from rdstitch import division_model
from rdstitch.camera import Camera
from rdstitch.division_model import distort, horizon_radius, nearest_one_parameter, undistort, valid_radius
from rdstitch.errors import ArgumentError
from rdstitch.synthetic import FisheyeLens


def test_one_coefficient_is_the_closed_form() -> None:
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (500, 2))
    np.testing.assert_allclose(distort(points, -0.4, (0.0, 1e-300)), distort(points, -0.4), rtol=1e-12)


def test_no_distortion_reaches_as_far_as_the_model_is_used() -> None:
    assert valid_radius(0.0) == np.inf
    assert valid_radius(-0.25) == pytest.approx(2.0)
    assert valid_radius(0.25) == pytest.approx(2.0)


@pytest.mark.parametrize("higher", [(0.02, 0.01), (0.3, 0.2), (-0.9, 0.3), (-0.2,)])
def test_the_root_is_the_same_where_newtons_method_has_to_be_guarded(
    higher: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    straight = np.random.default_rng(0).uniform(-3.0, 3.0, size=(500, 2))
    quick = distort(straight, -0.2, higher)
    monkeypatch.setattr(division_model, "_QUICK_STEPS", 1)
    guarded = distort(straight, -0.2, higher)
    assert np.isfinite(quick).any()
    np.testing.assert_allclose(guarded, quick, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(distort(straight[0], -0.2, higher), guarded[0])


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


@pytest.mark.parametrize("coefficients", [(1.2, 0.0, 0.0), (-0.4, 0.9, 0.0), (0.1, 0.1, 0.9)])
def test_a_camera_that_folds_anywhere_in_the_image_is_refused(coefficients: tuple[float, float, float]) -> None:
    with pytest.raises(ArgumentError, match="folds"):
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


def test_too_small_a_circle_is_no_camera() -> None:
    with pytest.raises(ArgumentError, match="next to nothing"):
        Camera((640, 480), -30.0)


def test_nearest_lambda_is_what_a_fit_of_measured_points_gives() -> None:
    lens = Camera((640, 480), -0.45, -0.06, (330.0, 230.0), distortion3=-0.01)
    nearest, rms, largest = lens.one_parameter_fit()
    radii = np.sqrt(lens._radii2())
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


def test_coefficients_beyond_what_can_be_computed_with_fold() -> None:
    """A damaged camera file holds them; what they are multiplied by would be infinite."""
    for coefficients in ((0.0, 1e308), (0.0, 0.0, 1e308), (-1e308, 1e308)):
        with pytest.raises(ArgumentError):
            Camera((640, 480), distortion=coefficients[0], distortion2=coefficients[1], distortion3=coefficients[-1])
