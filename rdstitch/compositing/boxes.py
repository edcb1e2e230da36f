"""Boxes of pixels, on the canvas or in a picture, and arrays of values on them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Box = tuple[int, int, int, int]
"""x0, y0, x1, y1, pixels, end exclusive."""

Float32Array = NDArray[np.float32]


def intersection(first: Box, second: Box) -> Box | None:
    """The common part of two boxes; None where there is none."""
    x0, y0 = max(first[0], second[0]), max(first[1], second[1])
    x1, y1 = min(first[2], second[2]), min(first[3], second[3])
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None


def encloses(outer: Box, inner: Box) -> bool:
    """Whether all of a box lies in another."""
    return outer[0] <= inner[0] and outer[1] <= inner[1] and inner[2] <= outer[2] and inner[3] <= outer[3]


def grown(box: Box, by: int) -> Box:
    """``box`` with ``by`` pixels more on each side."""
    return box[0] - by, box[1] - by, box[2] + by, box[3] + by


def aligned(box: Box, unit: int) -> Box:
    """The smallest box with edges at multiples of ``unit`` that holds ``box``."""
    x0, y0, x1, y1 = box
    return x0 // unit * unit, y0 // unit * unit, -(-x1 // unit) * unit, -(-y1 // unit) * unit


def without(box: Box, hole: Box | None) -> list[Box]:
    """What is left of a box: above, left, right and below of a hole in it."""
    if hole is None:
        return [box]
    (x0, y0, x1, y1), (left, top, right, bottom) = box, hole
    parts = [(x0, y0, x1, top), (x0, top, left, bottom), (right, top, x1, bottom), (x0, bottom, x1, y1)]
    return [part for part in parts if part[0] < part[2] and part[1] < part[3]]


def bounds(values: NDArray[Any], box: Box) -> Box | None:
    """Smallest box that holds all values on ``box`` that are not 0; None where there are none."""
    rows, columns = (np.flatnonzero(values.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return None
    x, y = box[:2]
    return int(x + columns[0]), int(y + rows[0]), int(x + columns[-1] + 1), int(y + rows[-1] + 1)


def cut(values: NDArray[Any], box: Box, part: Box) -> NDArray[Any]:
    """View of the values on ``box`` that lie on ``part``."""
    x, y = part[0] - box[0], part[1] - box[1]
    return values[y : y + part[3] - part[1], x : x + part[2] - part[0]]
