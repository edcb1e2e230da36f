"""Whether images look alike where they overlap, in place, a few pixels more or less."""

import math
from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np

from rdstitch.arrays import AnyArray, BoolArray, Float32Array, IntArray
from rdstitch.compositing.boxes import cut, intersection
from rdstitch.compositing.seam_quality import CONTRAST, UNLIKE, SeamTile, correlation

_COARSER = 3  # times smaller, that overlaps are compared
_CELL = 13  # pixels a side
_MIN_CELLS = 8  # fewer say nothing


class Likeness(NamedTuple):
    """What the overlaps of images look like; NaN and None where there is nothing to compare."""

    alike: float = math.nan
    fills: float = math.nan
    least_alike: tuple[int, int] | None = None


def likeness(tiles: Sequence[SeamTile | None], pairs: IntArray, full: float = 255.0) -> Likeness:
    """Compare the overlaps of pairs (P, 2) in place, a few pixels more or less; see :class:`SeamQuality`."""
    small = [None if tile is None else _smaller(tile) for tile in tiles]
    textured = [0 if tile is None else int(_textured(tile.grey, tile.inside, full)[1].sum()) for tile in small]
    counts_of_pairs: dict[tuple[int, int], tuple[int, int]] = {}
    shown = 0
    for i, j in pairs.tolist():
        first, second = small[i], small[j]
        if first is None or second is None or (box := intersection(first.box, second.box)) is None:
            continue
        (cells1, known1), (cells2, known2) = (
            _textured(cut(tile.grey, tile.box, box), cut(tile.inside, tile.box, box), full) for tile in (first, second)
        )
        known = known1 & known2
        alike = correlation(cells1[known], cells2[known]) > UNLIKE
        if len(alike) >= _MIN_CELLS:
            counts_of_pairs[min(i, j), max(i, j)] = len(alike), int(alike.sum())
            shown += min(textured[i], textured[j])
    if not counts_of_pairs:
        return Likeness()
    cells, alike_cells = (sum(counts) for counts in zip(*counts_of_pairs.values(), strict=True))
    worst = min(counts_of_pairs, key=lambda pair: counts_of_pairs[pair][1] / counts_of_pairs[pair][0])
    return Likeness(alike_cells / cells, 1.0 - (cells - alike_cells) / max(shown, cells), worst)


def _textured(grey: Float32Array, inside: BoolArray, full: float) -> tuple[Float32Array, BoolArray]:
    """Cells (N, pixels) of an image, and which of them show something."""
    cells = _in_cells(grey)
    shows = _in_cells(inside).all(axis=1) & (cells.std(axis=1) > CONTRAST * full)
    return cells, np.asarray(shows)


def _in_cells(values: AnyArray) -> AnyArray:
    """Values (h, w) by cells (N, pixels)."""
    rows, columns = (n // _CELL for n in values.shape)
    whole = values[: rows * _CELL, : columns * _CELL].reshape(rows, _CELL, columns, _CELL)
    return whole.swapaxes(1, 2).reshape(rows * columns, _CELL**2)


def _smaller(tile: SeamTile) -> SeamTile:
    """A tile with larger pixels, which begin where they do on the whole canvas."""
    x, y = (-start % _COARSER for start in tile.box[:2])
    rows, columns = (n // _COARSER for n in (tile.grey.shape[0] - y, tile.grey.shape[1] - x))
    left, top = (tile.box[0] + x) // _COARSER, (tile.box[1] + y) // _COARSER
    part = np.s_[y : y + rows * _COARSER, x : x + columns * _COARSER]
    grey, inside = _in_blocks(np.add, tile.grey[part].astype(np.float32)), _in_blocks(np.logical_and, tile.inside[part])
    return SeamTile((left, top, left + columns, top + rows), grey / np.float32(_COARSER**2), inside)


def _in_blocks(reduce_by: np.ufunc, values: AnyArray) -> AnyArray:
    """Values (h, w) reduced in blocks, by rows and then by columns: NumPy reduces short axes many times slower."""
    rows = reduce(reduce_by, [values[k::_COARSER] for k in range(_COARSER)])
    return np.asarray(reduce(reduce_by, [rows[:, k::_COARSER] for k in range(_COARSER)]))
