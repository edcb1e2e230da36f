"""Random cameras: what is undone is as before."""

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rdstitch.alignment.motion_models import HOMOGRAPHY, SIMILARITY, TILTING
from rdstitch.alignment.motion_models.homography import _TRACELESS
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.division_model import distort, undistort, valid_radius
from rdstitch.geometry.exif_orientation import inverse, turned, turning_matrix
from rdstitch.geometry.planar_motion import PlanarMotion, rotation_from_tilt, tilt_from_normal
from rdstitch.geometry.radial_homography import inverses
from rdstitch.matching.links import grid_subsample

coordinates = st.floats(-1.0, 1.0, allow_subnormal=False)
distortions = st.floats(-0.95, 0.45)


HIGHER = [(), (-0.02,), (0.03,), (-0.08, -0.02), (0.1, -0.05), (0.0, 0.04)]


@given(x=coordinates, y=coordinates, distortion=distortions, higher=st.sampled_from(HIGHER))
@example(x=0.5, y=0.5, distortion=2.2e-313, higher=())
@example(x=0.5, y=0.5, distortion=-2.2e-313, higher=(5e-324, 0.0))
def test_distort_inverts_undistort(x: float, y: float, distortion: float, higher: tuple[float, ...]) -> None:
    point = np.array([x, y])
    radius2 = float(point @ point)
    assume(radius2 <= 1.0)
    assume(radius2 < 0.9 * valid_radius(distortion, higher) ** 2)
    back = distort(undistort(point, distortion, higher), distortion, higher)
    np.testing.assert_allclose(back, point, atol=1e-10)


@given(distortion=st.floats(-1e-9, 1e-9), radius=st.floats(0.0, 1e-150))
def test_no_cancellation_at_the_centre_or_without_distortion(distortion: float, radius: float) -> None:
    point = np.array([radius, 0.0])
    np.testing.assert_array_equal(distort(point, distortion), point)
    np.testing.assert_allclose(distort([0.5, 0.5], distortion), [0.5, 0.5], atol=1e-9)


def test_outside_the_domain_is_nan_and_never_a_plausible_point() -> None:
    assert np.isnan(undistort([1.5, 0.0], -0.5)).all()
    assert np.isnan(distort([10.0, 0.0], 0.1)).all()
    assert np.isfinite(distort([1e6, 0.0], -0.5)).all()
    assert np.isnan(distort([5.0, 0.0], 0.1, (0.1,))).all()


@given(distortion=distortions, width=st.integers(2, 5000), height=st.integers(2, 5000))
def test_units_of_distortion_agree(distortion: float, width: int, height: int) -> None:
    focal = 0.8 * max(width, height)
    camera = Camera((width, height), distortion, focal=focal, focal_source="exif")
    corner = np.array([width - 0.5, height - 0.5])
    undistorted = camera.undistort(corner) - camera.center
    np.testing.assert_allclose(undistorted, (corner - camera.center) / (1.0 + distortion), rtol=1e-9)
    in_px = np.hypot(*(corner - camera.center))
    np.testing.assert_allclose(camera.distortion_px * in_px**2, distortion, atol=1e-12)
    np.testing.assert_allclose(camera.distortion_focal * (in_px / focal) ** 2, distortion, atol=1e-12)


def test_a_resized_image_shows_the_same_rays() -> None:
    camera = Camera((800, 600), -0.3, center=(410.0, 290.0), focal=700.0, focal_source="option")
    small = camera.resized((400, 300))
    corner = camera.undistort([-0.5, -0.5])
    np.testing.assert_allclose((corner + 0.5) / 2 - 0.5, small.undistort([-0.5, -0.5]))
    assert small.focal == 350.0
    assert small.distortion == camera.distortion


def test_sizes_may_be_arrays_and_points_are_pairs() -> None:
    camera = Camera((800, 600), -0.3)
    same, smaller = (camera.resized(np.array(size)) for size in ((800, 600), (400, 300)))  # type: ignore[arg-type]
    assert (same, smaller.image_size) == (camera, (400, 300))
    for points in (5.0, [[1.0], [2.0]], np.zeros((4, 3)), np.zeros((2, 7))):
        for convert in (camera.undistort, camera.distort, camera.normalize, camera.denormalize):
            with pytest.raises(ArgumentError, match=r"points must be an array of shape \(\.\.\., 2\), not"):
                convert(points)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_camera_turns_with_its_image(orientation: int) -> None:
    camera = Camera((800, 600), -0.3, center=(410.0, 290.0), tilt=(0.1, -0.05), tilt_std=(0.01, 0.02))
    upright = camera.turned(orientation)
    rows, columns = np.mgrid[0:600, 0:800].astype(float)
    # Where the image of a pixel's own coordinates says that it came from.
    u, v = (turned(samples, orientation) for samples in (columns, rows))
    assert upright.image_size == u.shape[::-1]
    x, y = np.round(upright.center).astype(int)
    assert (u[y, x], v[y, x]) == (410.0, 290.0)
    back = upright.turned(inverse(orientation))
    down = rotation_from_tilt(upright.tilt)[:, 2]
    expected = turning_matrix(orientation) @ rotation_from_tilt((0.1, -0.05))[:2, 2]
    np.testing.assert_allclose(down[:2], expected, atol=1e-12)
    np.testing.assert_allclose(back.tilt, (0.1, -0.05), atol=1e-12)
    assert (back.image_size, back.center, back.tilt_std) == (camera.image_size, camera.center, camera.tilt_std)


@pytest.mark.parametrize(
    "bad",
    [
        {"distortion": 1.0},
        {"distortion": np.nan},
        {"distortion_std": np.nan},
        {"center": (np.nan, np.nan)},
        {"focal": 0.0},
        {"focal": 1e9},
        {"focal": 500.0, "focal_std": -3.0},
        {"focal_source": "x"},
        {"tilt": (np.nan, 0.0)},
        {"tilt": (0.0, 0.0), "tilt_std": (0.0, np.nan)},
    ],
)
def test_impossible_cameras_are_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(ArgumentError):
        Camera((640, 480), **bad)


def _numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_subnormal=False)


def _relations(matrices: np.ndarray) -> np.ndarray:
    """Every image to the first, of determinant one."""
    h = matrices[:1] @ np.linalg.inv(matrices)
    return np.asarray(h / np.cbrt(np.linalg.det(h))[:, None, None])


@given(arrays(float, (3, 3, 3), elements=_numbers(-0.2, 0.2)), arrays(float, 8, elements=_numbers(-0.2, 0.2)))
def test_a_change_of_the_planes_frame_leaves_all_relations(change: np.ndarray, gauge: np.ndarray) -> None:
    poses = np.eye(3) + change
    frame = np.einsum("k,kij->ij", gauge, _TRACELESS)
    generators = poses @ frame @ np.linalg.inv(poses)
    basis = _TRACELESS.reshape(8, 9)
    step = np.linalg.lstsq(basis.T, generators.reshape(3, 9).T, rcond=None)[0].T
    moved = HOMOGRAPHY.retract(poses.reshape(3, 9), step).reshape(3, 3, 3)
    np.testing.assert_allclose(_relations(moved), _relations(poses), atol=1e-8)


@given(
    arrays(float, (3, 4), elements=_numbers(-1.5, 1.5)),
    arrays(float, 3, elements=_numbers(-0.3, 0.3)),
    _numbers(-3.0, 3.0),
    arrays(float, 2, elements=_numbers(-2.0, 2.0)),
)
def test_a_moved_plane_leaves_relations(
    planar: np.ndarray, natural: np.ndarray, turn: float, shift: np.ndarray
) -> None:
    """Position and yaw are relative: the whole path may be moved over the plane."""
    poses = np.column_stack([planar, np.zeros((3, 2))])
    shared = SIMILARITY.shared_from_physical(natural)
    c, s = np.cos(turn), np.sin(turn)
    moved = poses.copy()
    moved[:, 1:3] = poses[:, 1:3] @ np.array([[c, -s], [s, c]]).T + shift
    moved[:, 0] -= turn
    before, after = (_relations(SIMILARITY.matrices(p, shared).matrices) for p in (poses, moved))
    np.testing.assert_allclose(after, before, atol=1e-7)


@given(arrays(float, (2, 6), elements=_numbers(-0.5, 0.5)), arrays(float, 3, elements=_numbers(-0.3, 0.3)))
def test_inverses_are_inverses(poses: np.ndarray, natural: np.ndarray) -> None:
    matrices = TILTING.matrices(poses, TILTING.shared_from_physical(natural)).matrices
    np.testing.assert_allclose(inverses(matrices) @ matrices, np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-9)


@given(arrays(float, st.tuples(st.integers(1, 60), st.just(2)), elements=_numbers(-1.0, 1.0)), st.integers(1, 40))
def test_thinning_keeps_the_requested_number(points: np.ndarray, most: int) -> None:
    kept = grid_subsample(points, most)
    assert len(kept) == min(most, len(points))
    assert (np.diff(kept) > 0).all()


tilts = st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
translations = st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)).filter(lambda t: np.hypot(*t) > 0.05)
yaws = st.one_of(st.just(0.0), st.floats(0.05, 3.0), st.floats(-3.0, -0.05))
heights = st.one_of(st.just(1.0), st.floats(0.6, 0.95), st.floats(1.05, 1.6))
scales = st.floats(0.1, 10.0) | st.floats(-10.0, -0.1)


@given(tilt=tilts)
def test_tilt_is_read_back_from_the_normal(tilt: tuple[float, float]) -> None:
    np.testing.assert_allclose(tilt_from_normal(rotation_from_tilt(tilt)[:, 2]), tilt, atol=1e-12)


@given(tilt=tilts, yaw=yaws, translation=translations, height=heights, scale=scales)
def test_decomposition_inverts_composition(
    tilt: tuple[float, float], yaw: float, translation: tuple[float, float], height: float, scale: float
) -> None:
    motion = PlanarMotion(tilt, yaw, translation, height)
    found = PlanarMotion.from_homography(scale * motion.homography())
    np.testing.assert_allclose(found.homography(), motion.homography(), atol=1e-6)
    np.testing.assert_allclose(
        [*found.tilt, found.yaw, *found.translation, found.height], [*tilt, yaw, *translation, height], atol=1e-5
    )


def test_a_hopeless_matrix_still_gives_finite_numbers() -> None:
    for matrix in (np.eye(3), np.diag([1.0, 2.0, 3.0]), -np.eye(3)):
        found = PlanarMotion.from_homography(matrix)
        assert np.isfinite([*found.tilt, found.yaw, *found.translation, found.height]).all()


@pytest.mark.parametrize(
    "bad",
    [
        {"distortion": None},
        {"distortion": "0.1"},
        {"center": (1.0, 2.0, 3.0)},
        {"center": 4.0},
        {"focal": "500"},
        {"focal": (500.0, 500.0)},
        {"tilt": (0.1, 0.2, 0.3)},
        {"tilt_std": ("a", "b")},
        {"lens_covariance": ((1.0, 2.0),)},
        {"lens_covariance": ((0.0,) * 5,) * 4},
    ],
)
def test_values_of_another_shape_are_refused_by_name(bad: Any) -> None:
    with pytest.raises(ArgumentError, match=rf"{next(iter(bad))} of a camera must be .*numbers?, not"):
        Camera((640, 480), **bad)


def test_numbers_become_those_of_python() -> None:
    given: Any = {"distortion": np.float32(-0.25), "center": np.array([300, 200]), "focal": 500}
    camera = Camera((640, 480), **given)
    assert (camera.distortion, camera.center, camera.focal) == (-0.25, (300.0, 200.0), 500.0)
    nothing: Any = None
    assert Camera((640, 480), center=nothing) == Camera((640, 480))
