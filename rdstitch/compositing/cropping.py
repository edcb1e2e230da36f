"""What a crop leaves of the canvas: its largest part without holes."""

from typing import NamedTuple

import cv2
import numpy as np

from rdstitch.arrays import BoolArray
from rdstitch.compositing.boxes import Box, cut
from rdstitch.compositing.survey import Survey

# Rectangles are sought with at most this many pixels along the longer side of the canvas.
_RESOLUTION = 1500
# A rectangle that keeps less of what is covered is not worth cropping to.
_MIN_KEPT = 0.25


def covered_pixels(survey: Survey) -> BoolArray:
    """Which pixels of the reduced canvas images cover."""
    covered = np.zeros(survey.canvas.size[::-1], dtype=np.bool_)
    for tile in survey.tiles:
        if tile is not None:
            cut(covered, (0, 0, *survey.canvas.size), tile.box)[...] |= tile.inside
    return covered


class Crop(NamedTuple):
    """The largest part of a canvas without holes."""

    box: Box | None  # on the canvas; None where it is not worth cropping to
    kept: float  # fraction of what is covered that it keeps


def crop_box(covered: BoolArray, factor: int, size: tuple[int, int]) -> Crop:
    """Find the largest rectangle without holes.

    ``covered`` as of :func:`covered_pixels`, of which each takes ``factor`` pixels a side of a canvas of this size.
    """
    # A reduced pixel stands for those around its centre: one more on each side makes sure of all of them.
    whole = cv2.erode(
        covered.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=(0,)
    )
    coarse = max(1, -(-max(covered.shape) // _RESOLUTION))
    rows, columns = (n // coarse for n in whole.shape)
    cells = whole[: rows * coarse, : columns * coarse].reshape(rows, coarse, columns, coarse).min(axis=(1, 3)) > 0
    x0, y0, x1, y1 = largest_rectangle(cells)
    kept = (x1 - x0) * (y1 - y0) * coarse**2 / max(1, int(covered.sum()))
    unit = coarse * factor
    box = x0 * unit, y0 * unit, min(x1 * unit, size[0]), min(y1 * unit, size[1])
    return Crop(None if kept < _MIN_KEPT else box, kept)


def crop_rows(covered: BoolArray, factor: int, size: tuple[int, int], whole: Box) -> Crop:
    """Find the most rows without holes, at their full width, of a canvas that goes all the way round.

    ``whole`` is one full turn of it.
    """
    columns = slice(-(-whole[0] // factor), whole[2] // factor)
    full = np.concatenate([[False], covered[:, columns].all(axis=1), [False]])
    edges = np.flatnonzero(full[1:] != full[:-1]).reshape(-1, 2)
    first, last = edges[np.argmax(np.diff(edges, axis=1))] if len(edges) else (0, 0)
    # A reduced pixel stands for those around its centre: one row less on each side makes sure of all of them.
    first, last = first + (first > 0), last - (last < len(covered))
    kept = max(0, int(last - first)) * covered.shape[1] / max(1, int(covered.sum()))
    box = whole[0], int(first) * factor, whole[2], min(int(last) * factor, size[1])
    return Crop(None if kept < _MIN_KEPT else box, kept)


def largest_rectangle(cells: BoolArray) -> Box:
    """Largest upright rectangle of true cells: x0, y0, x1, y1, end exclusive; empty where there is none.

    Row by row, the height of the column of true cells above each cell, and for each the widest run of columns at least
    as high, found with a stack.
    """
    heights = np.zeros(cells.shape[1] + 1, dtype=np.int64)
    best, area = (0, 0, 0, 0), 0
    for y, row in enumerate(cells):
        heights[:-1] = np.where(row, heights[:-1] + 1, 0)
        # Only where the column ends below can a rectangle be the largest; but a row's bound is cheap to test.
        if int(heights.max()) * cells.shape[1] <= area:
            continue
        stack: list[tuple[int, int]] = []
        for x, height in enumerate(heights.tolist()):
            start = x
            while stack and stack[-1][1] >= height:
                start, tall = stack.pop()
                if tall * (x - start) > area:
                    area = tall * (x - start)
                    best = (start, y + 1 - tall, x, y + 1)
            stack.append((start, height))
    return best
