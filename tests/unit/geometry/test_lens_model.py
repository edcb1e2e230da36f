"""Lens models of other programs: what is undone is as before, and NaN where there is nothing to undo."""

import numpy as np
import pytest

from rdstitch.geometry.lens_model import LensKind, LensModel


@pytest.mark.parametrize(
    ("kind", "coefficients"),
    [
        ("fisheye", (0.05, -0.01)),
        ("fisheye polynomial", (-0.05, 0.02)),
        ("polynomial", (-0.05, 0.02)),
        ("brown", (-0.05, 0.01, 1e-3, 2e-3)),
    ],
)
def test_undistort_inverts_distort(kind: LensKind, coefficients: tuple[float, ...]) -> None:
    lens = LensModel((500.0, 510.0), (800.0, 600.0), coefficients, kind)
    farthest = 4000.0 if "fisheye" in kind else 500.0
    points = np.array([[0.0, 0.0], [0.0, 1e-9], [0.1, 0.9], [-0.7, 0.2], [0.0, -1.0]]) * farthest + lens.center
    np.testing.assert_allclose(lens.undistort(lens.distort(points)), points, atol=1e-8)


def test_what_no_ray_is_measured_at_is_nan() -> None:
    fisheye = LensModel((500.0, 500.0), (0.0, 0.0), (), "fisheye")
    beyond = 500.0 * np.array([[np.pi / 2 - 0.1, 0.0], [np.pi / 2 + 0.1, 0.0]])
    np.testing.assert_array_equal(np.isfinite(fisheye.undistort(beyond)), [[True, True], [False, False]])
    folding = LensModel((500.0, 500.0), (0.0, 0.0), (-0.5,))
    assert np.isnan(folding.undistort(np.array([[900.0, 0.0]]))).all()
