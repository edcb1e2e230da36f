"""Scores of hypotheses: transfer errors in pixels, truncated; which hypotheses are possible at all."""

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.radial_homography import transfer
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.scoring import plausible, transfer_errors2, truncated_costs
from rdstitch.solvers.solutions import Solutions

SIZES = (640, 480), (320, 240)
CAMERAS = Camera(SIZES[0]), Camera(SIZES[1])
POINTS = np.random.default_rng(0).uniform((0.0, 0.0), (639.0, 479.0), (40, 2))
H = np.array([[1.05, 0.1, 0.05], [-0.08, 0.97, -0.1], [0.03, -0.06, 1.0]])


def _measurements() -> Measurements:
    points2 = CAMERAS[1].denormalize(transfer(H, -0.2, CAMERAS[0].normalize(POINTS)))
    return Measurements.from_pixels(POINTS, points2 + np.array([0.3, -0.4]), *CAMERAS)


def test_errors_are_pixels_of_the_second_image() -> None:
    data = _measurements()
    pair = np.zeros(2, dtype=np.intp)
    errors = transfer_errors2(np.stack([H, 3.0 * H]), np.array([-0.2, -0.2]), pair, data)
    np.testing.assert_allclose(errors[:, :40], 0.25, rtol=1e-9)


def test_there_is_no_error_behind_the_camera_nor_beyond_the_lens() -> None:
    data = _measurements()
    pair = np.zeros(2, dtype=np.intp)
    behind, beyond = transfer_errors2(np.stack([-H, 4.0 * np.diag([1.0, 1.0, 0.25])]), np.array([0.0, 0.9]), pair, data)
    assert np.isinf(behind[:40]).all()
    # 1 - 4 λ r² is negative far from the centre, r four times the undistorted radius in image 1.
    far = np.linalg.norm(4.0 * data.x1[0, :, :40], axis=0) / (1.0 + 0.9 * data.radius2[0, :40])
    np.testing.assert_array_equal(np.isinf(beyond[:40]), 1.0 - 3.6 * far**2 < 0.0)
    assert 0 < np.isinf(beyond[:40]).sum() < 40


def test_padding_costs_nothing() -> None:
    data = _measurements()
    assert data.present.shape[1] > 40 or data.present.all()
    half = data.only(np.arange(data.present.shape[1])[None] < 20)
    exact = truncated_costs(H[None], np.array([-0.2]), np.zeros(1, dtype=np.intp), half, 1.0)
    assert exact == pytest.approx(0.25 * 20 / 40, rel=1e-9)


@pytest.mark.parametrize(
    ("matrix", "distortion", "possible"),
    [
        (np.eye(3), 0.0, True),
        (np.eye(3), -0.99, True),
        (np.eye(3), -1.01, False),  # folds at the corner
        (np.eye(3), 1.01, False),  # the undistorted radius stops growing
        (np.diag([1.0, -1.0, 1.0]), 0.0, False),  # mirrored
        (np.diag([1.0, 1e-4, 1.0]), 0.0, True),
        (np.diag([1.0, 1e-6, 1.0]), 0.0, False),  # a line
        (1e6 * np.eye(3), 0.0, True),  # of any scale
        (np.full((3, 3), np.nan), 0.0, False),
    ],
)
def test_images_of_a_plane_are_possible(matrix: np.ndarray, distortion: float, possible: bool) -> None:
    found = Solutions(np.zeros(1, dtype=np.intp), matrix[None], np.array([distortion]))
    assert plausible(found, corner_radius=1.0).tolist() == [possible]


def test_the_lens_is_judged_at_the_corner() -> None:
    found = Solutions(np.zeros(1, dtype=np.intp), np.eye(3)[None], np.array([-0.5]))
    assert [bool(plausible(found, radius)[0]) for radius in (1.0, 1.4, 1.5)] == [True, True, False]
