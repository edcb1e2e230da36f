"""Boxes: px by px, they are sets."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rdstitch.compositing.boxes import Box, aligned, bounds, cut, encloses, grown, intersection, without

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
