"""The canvas: size, scale, rotation, and refusal of what is absurd."""

import numpy as np
import pytest

from rdstitch.camera import Camera
from rdstitch.compositing import plan_canvas
from rdstitch.errors import ArgumentError, LimitError

FLAT = Camera((400, 300))


def _shift(x: float, y: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def test_one_flat_image_is_its_own_canvas() -> None:
    canvas = plan_canvas([FLAT], np.eye(3)[None])
    assert canvas.size == (400, 300)
    # Plane coordinates of the top-left px go to (0, 0).
    point = canvas.matrix @ np.append(FLAT.normalize((0.0, 0.0)), 1.0)
    np.testing.assert_allclose(point, [0, 0, 1], atol=1e-9)
    assert canvas.box(0) == (0, 0, 400, 300)


def test_neighbours_side_by_side() -> None:
    step = 100 / FLAT.scale
    canvas = plan_canvas([FLAT, FLAT], np.stack([np.eye(3), _shift(step, 0.0)]))
    assert canvas.size == (500, 300)
    assert canvas.box(1)[0] == 99 or canvas.box(1)[0] == 100


def test_scale_and_rotation() -> None:
    assert plan_canvas([FLAT], np.eye(3)[None], scale=0.5).size == (200, 150)
    assert plan_canvas([FLAT], np.eye(3)[None], rotate=90).size == (300, 400)
    turned = plan_canvas([FLAT], np.eye(3)[None], rotate=90)
    # Clockwise: what was top-left is now top-right.
    corner = turned.matrix @ np.append(FLAT.normalize((0.0, 0.0)), 1.0)
    np.testing.assert_allclose(corner[:2], [299, 0], atol=1e-9)


def test_resolution_at_the_centre_is_kept() -> None:
    lens = Camera((1000, 800), distortion=-0.3)
    matrix = np.array([[0.9, 0.1, 3.0], [-0.1, 0.95, 1.0], [0.02, -0.05, 1.0]])
    canvas = plan_canvas([lens], matrix[None])
    middle = np.array(lens.center)
    flat = lens.normalize(lens.undistort(middle + np.array([[-0.5, 0], [0.5, 0], [0, -0.5], [0, 0.5]])))
    z = np.column_stack([flat, np.ones(4)]) @ (canvas.matrix @ matrix).T
    left, right, top, bottom = z[:, :2] / z[:, 2:]
    assert abs(np.linalg.det(np.stack([right - left, bottom - top]))) == pytest.approx(1.0, abs=1e-3)


def test_curved_outline_is_inside() -> None:
    """With pincushion distortion the sides bulge beyond the corners."""
    lens = Camera((1000, 800), distortion=0.3)
    canvas = plan_canvas([lens], np.eye(3)[None])
    border = lens.normalize(lens.undistort(lens.outline(500)))
    points = np.column_stack([border, np.ones(len(border))]) @ canvas.matrix.T
    assert points[:, :2].min() > -0.5 - 0.05
    assert (points[:, :2].max(axis=0) < np.array(canvas.size) - 0.5 + 0.05).all()


def test_homography_scale_and_sign_do_not_matter() -> None:
    matrices = np.stack([np.eye(3), _shift(0.4, 0.1)])
    a, b = plan_canvas([FLAT] * 2, matrices), plan_canvas([FLAT] * 2, matrices * np.array([-3.0, 0.2])[:, None, None])
    assert a.size == b.size
    np.testing.assert_allclose(a.footprints[1], b.footprints[1], atol=1e-9)


def test_absurd_canvases_are_refused_by_name() -> None:
    names = ["a.jpg", "b.jpg"]
    horizon = np.array([[1.0, 0, 0], [0, 1, 0], [1.5, 0, 1]])
    with pytest.raises(LimitError, match=r"b\.jpg: the horizon"):
        plan_canvas([FLAT] * 2, np.stack([np.eye(3), horizon]), names=names)
    with pytest.raises(LimitError, match=r"b\.jpg: would be mirrored"):
        plan_canvas([FLAT] * 3, np.stack([np.eye(3), np.diag([-1.0, 1, 1]), np.eye(3)]), names=[*names, "c.jpg"])
    with pytest.raises(LimitError, match=r"b\.jpg lies farthest"):
        plan_canvas([FLAT] * 3, np.stack([np.eye(3), _shift(300, 300), np.eye(3)]), names=[*names, "c.jpg"])
    near_horizon = np.array([[1.0, 0, 0], [0, 1, 0], [1.2, 0, 1]])
    with pytest.raises(LimitError, match=r"b\.jpg: would be stretched"):
        plan_canvas([FLAT] * 2, np.stack([np.eye(3), near_horizon]), names=names, reference=0)


@pytest.mark.parametrize("options", [{"scale": 0.0}, {"scale": np.nan}, {"rotate": np.inf}])
def test_wrong_options(options: dict[str, float]) -> None:
    with pytest.raises(ArgumentError):
        plan_canvas([FLAT], np.eye(3)[None], **options)  # type: ignore[arg-type]


def test_wrong_homographies() -> None:
    for matrices in (np.eye(3), np.zeros((1, 3, 3)), np.full((1, 3, 3), np.nan), np.stack([np.eye(3)] * 2)):
        with pytest.raises(ArgumentError):
            plan_canvas([FLAT], matrices)


def test_cropped_and_reduced_keep_the_geometry() -> None:
    canvas = plan_canvas([FLAT], np.eye(3)[None])
    part = canvas.cropped((30, 40, 130, 90))
    assert part.size == (100, 50)
    point = np.append(FLAT.normalize((30.0, 40.0)), 1.0)
    np.testing.assert_allclose((part.matrix @ point)[:2], [0, 0], atol=1e-9)
    half = canvas.reduced(2)
    assert half.size == (200, 150)
    # The centre of the first reduced px is the middle of four px.
    np.testing.assert_allclose((half.matrix @ np.append(FLAT.normalize((0.5, 0.5)), 1.0))[:2], [0, 0], atol=1e-9)
