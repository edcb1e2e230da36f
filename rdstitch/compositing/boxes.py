"""Boxes of pixels, on the canvas or in an image, arrays of values on them, and which of many boxes overlap."""

from collections.abc import Sequence

import numpy as np

from rdstitch.arrays import AnyArray, FloatArray, IntArray
from rdstitch.system.late_imports import csgraph, sparse

Box = tuple[int, int, int, int]
"""x0, y0, x1, y1, pixels, end exclusive."""

# All of them in ordinary folders; a survey with 70 and 50 % of overlap has about 20.
_MAX_NEIGHBOURS = 20
_BOXES_AT_ONCE = 256  # that are compared with the others: of 10,000 each may have hundreds beside it


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


def bounds(values: AnyArray, box: Box) -> Box | None:
    """Smallest box that holds all values on ``box`` that are not 0; None where there are none."""
    rows, columns = (np.flatnonzero(values.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return None
    x, y = box[:2]
    return int(x + columns[0]), int(y + rows[0]), int(x + columns[-1] + 1), int(y + rows[-1] + 1)


def cut(values: AnyArray, box: Box, part: Box) -> AnyArray:
    """View of the values on ``box`` that lie on ``part``."""
    x, y = part[0] - box[0], part[1] - box[1]
    return values[y : y + part[3] - part[1], x : x + part[2] - part[0]]


def overlapping_pairs(boxes: Sequence[Box | None], most: int = _MAX_NEIGHBOURS) -> IntArray:
    """Pairs of boxes that have pixels in common, found without looking at every pair.

    Shape (P, 2), ascending, the larger index first; None is an image that is nowhere. Where a box overlaps more than
    ``most`` others, those with which it shares most, and a spanning tree of the largest overlaps.
    """
    present = np.array([k for k, box in enumerate(boxes) if box is not None], dtype=np.intp)
    edges = np.array([box for box in boxes if box is not None], dtype=np.intp).reshape(-1, 4)
    if len(edges) < 2:
        return np.zeros((0, 2), dtype=np.intp)
    # Along the longer side of the canvas, each box is compared with those that begin before it ends.
    along = int(np.ptp(edges[:, 1]) > np.ptp(edges[:, 0]))
    order = np.argsort(edges[:, along], kind="stable")
    present, edges = present[order], edges[order]
    place, last = np.arange(len(edges)), np.searchsorted(edges[:, along], edges[:, along + 2])
    overlaps = [np.zeros((2, 0), dtype=np.intp)]
    for part in np.split(place, np.arange(_BOXES_AT_ONCE, len(place), _BOXES_AT_ONCE)):
        later = last[part] - part - 1
        first = np.repeat(part, later)
        second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(later) - later, later)
        overlaps.append(np.stack([first, second])[:, (_sides(edges, first, second) > 0).all(axis=1)])
    first, second = np.concatenate(overlaps, axis=1)
    sides = _sides(edges, first, second)
    areas = (edges[:, 2:] - edges[:, :2]).prod(axis=1)
    fraction = sides.prod(axis=1) / np.minimum(areas[first], areas[second])
    pairs = np.sort(np.stack([present[first], present[second]], axis=1), axis=1)[:, ::-1]
    ascending = np.lexsort((pairs[:, 1], pairs[:, 0]))
    return _largest(pairs[ascending], fraction[ascending], len(boxes), most)


def _sides(edges: IntArray, first: IntArray, second: IntArray) -> IntArray:
    """Width and height (P, 2) of what boxes have in common, by their edges (N, 4); not positive without any."""
    return np.minimum(edges[first, 2:], edges[second, 2:]) - np.maximum(edges[first, :2], edges[second, :2])


def _largest(pairs: IntArray, fraction: FloatArray, count: int, most: int) -> IntArray:
    """The pairs of the largest shares, ``most`` of each image, and a spanning tree."""
    ends = pairs.T.ravel()
    degree = np.bincount(ends, minlength=count)
    if degree.max(initial=0) <= most:
        return pairs
    ranked = np.lexsort((-np.tile(fraction, 2), ends))
    rank = np.arange(len(ends)) - np.repeat(np.cumsum(degree) - degree, degree)
    kept = np.zeros(len(pairs), dtype=np.bool_)
    kept[ranked[rank < most] % len(pairs)] = True
    # Weights above 0, smallest for the largest share.
    weights = sparse.csr_array((2.0 - fraction, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    tree = csgraph.minimum_spanning_tree(weights).tocoo()
    kept |= np.isin(pairs @ [count, 1], tree.row.astype(np.intp) * count + tree.col)
    return pairs[kept]
