"""Fewer correspondences of a pair, evenly spread over its overlap."""

import numpy as np

from rdstitch.arrays import FloatArray, IntArray


def spread_choice(points: FloatArray, most: int | None) -> IntArray:
    """Indices of about ``most`` of the points (M, 2), ascending, evenly spread over their bounding box.

    The points are dealt out by the cells of a grid: first one of each cell, then the second of each, until there
    are enough.
    """
    count = len(points)
    if most is None or count <= most:
        return np.arange(count)
    low, high = points.min(axis=0), points.max(axis=0)
    side = max(int(np.sqrt(most)), 1)
    cell = np.minimum(((points - low) / np.maximum(high - low, 1e-12) * side).astype(np.intp), side - 1)
    number = cell[:, 0] * side + cell[:, 1]
    order = np.argsort(number, kind="stable")
    _, first, sizes = np.unique(number[order], return_index=True, return_counts=True)
    turn = np.empty(count, dtype=np.intp)
    turn[order] = np.arange(count) - np.repeat(first, sizes)
    return np.sort(np.argsort(turn, kind="stable")[:most])
