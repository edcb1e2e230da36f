"""Which pictures lie over each other on the canvas, found without looking at every pair."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import minimum_spanning_tree

from rdstitch.arrays import FloatArray
from rdstitch.compositing.boxes import Box

# All of them in ordinary folders; a survey with 70 and 50 % of overlap has about 20.
_MAX_NEIGHBOURS = 40


def overlapping_pairs(boxes: Sequence[Box | None], most: int = _MAX_NEIGHBOURS) -> NDArray[np.intp]:
    """Pairs of boxes that have pixels in common.

    Parameters
    ----------
    boxes : sequence of Box or None
        None for a picture that is nowhere.
    most : int
        Where a box overlaps more others, so many of them: those with which it shares most, and what it takes for all
        that is connected to stay so (a spanning tree of the largest overlaps).

    Returns
    -------
    ndarray of shape (P, 2), int
        The larger index first, in ascending order.
    """
    present = np.array([k for k, box in enumerate(boxes) if box is not None], dtype=np.intp)
    edges = np.array([box for box in boxes if box is not None], dtype=np.intp).reshape(-1, 4)
    if len(edges) < 2:
        return np.zeros((0, 2), dtype=np.intp)
    # Along the longer side of the canvas, each box is compared with those that begin before it ends.
    along = int(np.ptp(edges[:, 1]) > np.ptp(edges[:, 0]))
    order = np.argsort(edges[:, along], kind="stable")
    present, edges = present[order], edges[order]
    place = np.arange(len(edges))
    later = np.searchsorted(edges[:, along], edges[:, along + 2]) - place - 1
    first = np.repeat(place, later)
    second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(later) - later, later)
    sides = np.minimum(edges[first, 2:], edges[second, 2:]) - np.maximum(edges[first, :2], edges[second, :2])
    both = (sides > 0).all(axis=1)
    first, second, sides = first[both], second[both], sides[both]
    areas = (edges[:, 2:] - edges[:, :2]).prod(axis=1)
    share = sides.prod(axis=1) / np.minimum(areas[first], areas[second])
    pairs = np.sort(np.stack([present[first], present[second]], axis=1), axis=1)[:, ::-1]
    ascending = np.lexsort((pairs[:, 1], pairs[:, 0]))
    return _largest(pairs[ascending], share[ascending], len(boxes), most)


def _largest(pairs: NDArray[np.intp], share: FloatArray, count: int, most: int) -> NDArray[np.intp]:
    """The pairs of the largest shares, ``most`` of each picture, and a spanning tree."""
    ends = pairs.T.ravel()
    degree = np.bincount(ends, minlength=count)
    if degree.max(initial=0) <= most:
        return pairs
    ranked = np.lexsort((-np.tile(share, 2), ends))
    rank = np.arange(len(ends)) - np.repeat(np.cumsum(degree) - degree, degree)
    kept = np.zeros(len(pairs), dtype=np.bool_)
    kept[ranked[rank < most] % len(pairs)] = True
    # Weights above 0, smallest for the largest share.
    weights = sparse.csr_array((2.0 - share, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    tree = minimum_spanning_tree(weights).tocoo()
    kept |= np.isin(pairs @ [count, 1], tree.row.astype(np.intp) * count + tree.col)
    return pairs[kept]
