"""The canvas: its size, its boxes and what is cropped."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rdstitch.arrays import BoolArray
from rdstitch.compositing import CompositeOptions, plan_canvas, plan_composite, plan_panorama
from rdstitch.compositing.boxes import Box, aligned, bounds, cut, encloses, grown, intersection, without
from rdstitch.compositing.cropping import crop_box, crop_rows, largest_rectangle
from rdstitch.errors import ArgumentError, LimitError
from rdstitch.geometry.camera import Camera

FLAT = Camera((400, 300))


def _shift(x: float, y: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def test_one_flat_image_is_its_own_canvas_and_neighbours_lie_side_by_side() -> None:
    canvas = plan_canvas([FLAT], np.eye(3)[None])
    assert canvas.size == (400, 300)
    # Plane coordinates of the top-left px go to (0, 0).
    point = canvas.matrix @ np.append(FLAT.normalize((0.0, 0.0)), 1.0)
    np.testing.assert_allclose(point, [0, 0, 1], atol=1e-9)
    assert canvas.box(0) == (0, 0, 400, 300)
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


def test_wrong_options_and_homographies() -> None:
    options: list[dict[str, Any]] = [{"scale": 0.0}, {"scale": np.nan}, {"rotate": np.inf}, {"names": []}]
    for plan in (plan_canvas, partial(plan_panorama, projection="sphere")):
        for wrong in (*options, {"max_stretch": 1.0}, {"max_stretch": np.nan}, {"reference": 1}):
            with pytest.raises(ArgumentError):
                plan([FLAT], np.eye(3)[None], **wrong)
        for matrices in (np.eye(3), np.zeros((1, 3, 3)), np.full((1, 3, 3), np.nan), np.stack([np.eye(3)] * 2)):
            with pytest.raises(ArgumentError):
                plan([FLAT], matrices)
    with pytest.raises(ArgumentError, match=r"projection must be one of auto, plane, .*, not 'fisheye'"):
        plan_panorama([FLAT], np.eye(3)[None], projection="fisheye")  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match="is for 1 images, not for 0"):
        plan_composite([], plan_canvas([FLAT], np.eye(3)[None]), CompositeOptions())


def test_cropped_and_reduced_keep_the_geometry() -> None:
    canvas = plan_canvas([FLAT], np.eye(3)[None])
    part = canvas.cropped((30, 40, 130, 90))
    assert part.size == (100, 50)
    point = np.append(FLAT.normalize((30.0, 40.0)), 1.0)
    np.testing.assert_allclose((part.matrix @ point)[:2], [0, 0], atol=1e-9)
    half = replace(canvas, orientation=np.diag([1.0, 1.0, 2.0]), cropped_to=(0, 0, 9, 9)).reduced(2)
    np.testing.assert_array_equal(half.orientation, np.diag([1.0, 1.0, 2.0]))
    assert half.cropped_to is None  # of the whole canvas' pixels
    assert half.size == (200, 150)
    # The centre of the first reduced px is the middle of four px.
    np.testing.assert_allclose((half.matrix @ np.append(FLAT.normalize((0.5, 0.5)), 1.0))[:2], [0, 0], atol=1e-9)


SIDE = 12
LIMITS = st.lists(st.integers(0, SIDE), min_size=2, max_size=2, unique=True).map(sorted)
BOXES = st.tuples(LIMITS, LIMITS).map(lambda xy: (xy[0][0], xy[1][0], xy[0][1], xy[1][1]))


def px(box: Box | None) -> NDArray[np.bool_]:
    """Which px of a square a box holds."""
    held = np.zeros((SIDE, SIDE), dtype=np.bool_)
    if box is not None:
        held[box[1] : box[3], box[0] : box[2]] = True
    return held


@given(BOXES, BOXES)
def test_two_boxes(first: Box, second: Box) -> None:
    common = intersection(first, second)
    np.testing.assert_array_equal(px(common), px(first) & px(second))
    assert (common is None) == (not px(common).any())
    assert encloses(first, second) == (not (px(second) & ~px(first)).any())
    if common is not None:
        parts = without(first, common)
        np.testing.assert_array_equal(sum(px(part).astype(int) for part in parts), px(first) & ~px(common))
        values = np.arange(SIDE**2).reshape(SIDE, SIDE)
        on_first = cut(values, (0, 0, SIDE, SIDE), first)
        np.testing.assert_array_equal(cut(on_first, first, common).ravel(), values[px(common)])
    assert without(first, None) == [first]


@given(BOXES, st.sampled_from([1, 2, 4, 8]))
def test_a_box_and_the_next_multiples(box: Box, unit: int) -> None:
    whole = aligned(box, unit)
    assert encloses(whole, box)
    assert all(edge % unit == 0 for edge in whole)
    assert max(np.subtract(box[:2], whole[:2]).max(), np.subtract(whole[2:], box[2:]).max()) < unit
    assert grown(grown(box, 3), -3) == box


@given(BOXES)
def test_bounds_of_what_is_not_zero(box: Box) -> None:
    corners = np.zeros((SIDE, SIDE))
    corners[box[1], box[0]] = corners[box[3] - 1, box[2] - 1] = 0.5
    assert bounds(corners, (0, 0, SIDE, SIDE)) == box
    assert bounds(corners, (30, -5, 30 + SIDE, -5 + SIDE)) == (box[0] + 30, box[1] - 5, box[2] + 30, box[3] - 5)
    assert bounds(np.zeros((SIDE, SIDE)), (0, 0, SIDE, SIDE)) is None


def _covered(height: int, width: int, y: slice = slice(None), x: slice = slice(None)) -> BoolArray:
    covered = np.zeros((height, width), dtype=np.bool_)
    covered[y, x] = True
    return covered


@pytest.mark.parametrize(
    ("y", "x", "box"),
    [
        (slice(2, 18), slice(5, 29), (18, 9, 84, 51)),  # one reduced pixel less on each side, of 3 pixels
        (slice(None), slice(None), (3, 3, 87, 57)),
    ],
)
def test_a_covered_box_is_kept_but_for_its_border(y: slice, x: slice, box: tuple[int, int, int, int]) -> None:
    assert crop_box(_covered(20, 30, y, x), 3, (88, 58)).box == box


def test_large_coverage_is_looked_at_in_cells_that_are_covered_whole() -> None:
    covered = _covered(4, 3100)
    covered = np.repeat(covered, 30, axis=0)  # 120 x 3100: cells of 3 x 3
    covered[40, 1500] = False
    box, _ = crop_box(covered, 2, (6200, 240))
    # Eroded by a pixel, (1499, 39) to (1501, 41) are holes: columns of cells 499 and 500, rows of cells 13.
    assert box == (6, 84, 6198, 234)


@pytest.mark.parametrize(("side", "kept"), [(11, 0.20), (12, 0.24), (13, 0.27)])
def test_a_rectangle_that_keeps_less_than_a_quarter_is_not_worth_it(side: int, kept: float) -> None:
    """A square that loses its border, and stripes of one pixel, which lose everything."""
    covered = _covered(60, 60, slice(0, side), slice(0, side))
    covered[20:58:4, 5:33] = True  # 280 more
    crop = crop_box(covered, 1, (60, 60))
    assert (crop.box is None) is (kept < 0.25)
    assert crop.kept == pytest.approx(kept, abs=0.005)


def test_rows_of_a_full_turn() -> None:
    covered = _covered(40, 25, slice(5, 33))
    covered[10, 7] = False
    assert crop_rows(covered, 4, (100, 160), (3, 0, 97, 160)).box == (3, 48, 97, 128)
    covered[10, 7], covered[20, 24] = True, False  # beyond the turn, which ends within column 24
    assert crop_rows(covered, 4, (100, 160), (3, 0, 97, 160)).box == (3, 24, 97, 128)
    covered[20, 0] = False  # as column 0 begins before it
    assert crop_rows(covered, 4, (100, 160), (3, 0, 97, 160)).box == (3, 24, 97, 128)
    assert crop_rows(_covered(40, 25), 4, (100, 158), (0, 0, 100, 158)).box == (0, 0, 100, 158)


def test_rows_that_keep_less_than_a_quarter_are_not_worth_it() -> None:
    covered = _covered(40, 10)
    covered[12:, 3] = False
    assert crop_rows(covered, 1, (10, 40), (0, 0, 10, 40)).box == (0, 0, 10, 11)
    covered[9:12, 3] = False
    crop = crop_rows(covered, 1, (10, 40), (0, 0, 10, 40))
    assert crop.box is None
    assert crop.kept == pytest.approx(0.22, abs=0.005)
    covered[:, 3] = False
    assert crop_rows(covered, 1, (10, 40), (0, 0, 10, 40)) == (None, 0.0)
    assert largest_rectangle(np.zeros((3, 4), dtype=np.bool_)) == (0, 0, 0, 0)
    assert largest_rectangle(np.eye(3, dtype=np.bool_)) == (0, 0, 1, 1)
