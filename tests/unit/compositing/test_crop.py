"""Boxes that are cropped to, by hand-made coverage."""

import numpy as np
import pytest

from rdstitch.arrays import BoolArray
from rdstitch.compositing.crop import crop_box, crop_rows, largest_rectangle


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
    assert crop_box(_covered(20, 30, y, x), 3, (88, 58)) == (box, "")


def test_large_coverage_is_looked_at_in_cells_that_are_covered_whole() -> None:
    covered = _covered(4, 3100)
    covered = np.repeat(covered, 30, axis=0)  # 120 x 3100: cells of 3 x 3
    covered[40, 1500] = False
    box, _ = crop_box(covered, 2, (6200, 240))
    # Eroded by a pixel, (1499, 39) to (1501, 41) are holes: columns of cells 499 and 500, rows of cells 13.
    assert box == (6, 84, 6198, 234)


@pytest.mark.parametrize(("side", "kept"), [(11, "20 %"), (12, "24 %"), (13, None)])
def test_a_rectangle_that_keeps_less_than_a_quarter_is_not_worth_it(side: int, kept: str | None) -> None:
    """A square that loses its border, and stripes of one pixel, which lose everything."""
    covered = _covered(60, 60, slice(0, side), slice(0, side))
    covered[20:58:4, 5:33] = True  # 280 more
    box, why = crop_box(covered, 1, (60, 60))
    assert (box is None) is (kept is not None)
    assert (kept or "") in why


def test_rows_of_a_full_turn() -> None:
    covered = _covered(40, 25, slice(5, 33))
    covered[10, 7] = False
    assert crop_rows(covered, 4, (100, 160), (3, 0, 97, 160)) == ((3, 48, 97, 128), "")
    covered[10, 7], covered[20, 24] = True, False  # beyond the turn, which ends within column 24
    assert crop_rows(covered, 4, (100, 160), (3, 0, 97, 160)) == ((3, 24, 97, 128), "")
    covered[20, 0] = False  # as column 0 begins before it
    assert crop_rows(covered, 4, (100, 160), (3, 0, 97, 160))[0] == (3, 24, 97, 128)
    assert crop_rows(_covered(40, 25), 4, (100, 158), (0, 0, 100, 158)) == ((0, 0, 100, 158), "")


def test_rows_that_keep_less_than_a_quarter_are_not_worth_it() -> None:
    covered = _covered(40, 10)
    covered[12:, 3] = False
    assert crop_rows(covered, 1, (10, 40), (0, 0, 10, 40)) == ((0, 0, 10, 11), "")
    covered[9:12, 3] = False
    box, why = crop_rows(covered, 1, (10, 40), (0, 0, 10, 40))
    assert box is None
    assert "would keep 22 %" in why
    covered[:, 3] = False
    assert crop_rows(covered, 1, (10, 40), (0, 0, 10, 40)) == (
        None,
        "not cropped: the rows without holes would keep 0 % of the image",
    )


def test_the_largest_rectangle_of_nothing_is_empty() -> None:
    assert largest_rectangle(np.zeros((3, 4), dtype=np.bool_)) == (0, 0, 0, 0)
    assert largest_rectangle(np.eye(3, dtype=np.bool_)) == (0, 0, 1, 1)
