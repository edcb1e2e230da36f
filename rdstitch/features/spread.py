"""Which keypoints to keep: the strongest, or the strongest everywhere."""

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray


def strongest(response: FloatArray, count: int) -> NDArray[np.intp]:
    """Indices of the ``count`` strongest keypoints, strongest first, ties in input order."""
    return np.argsort(-response, kind="stable")[:count]


def spread(points: FloatArray, response: FloatArray, count: int, cell: float) -> NDArray[np.intp]:
    """Indices of ``count`` keypoints that are spread over the picture, strongest first.

    The cells of a grid take turns, each giving its strongest keypoint that is left, until ``count`` are
    taken: no cell gets more than another that still has some. The corners, where the distortion is seen, thus
    keep what they have however strong the middle of the picture is.

    Parameters
    ----------
    points : ndarray of shape (N, 2)
        pixels.
    response : ndarray of shape (N,)
    count : int
        Keypoints to keep at most.
    cell : float
        Side of a cell, pixels.
    """
    if len(points) <= count:
        return strongest(response, count)
    column, row = np.floor(points / cell).astype(np.int64).T
    by_cell = np.lexsort((-response, column, row))
    is_first = np.ones(len(points), dtype=bool)
    is_first[1:] = (np.diff(column[by_cell]) != 0) | (np.diff(row[by_cell]) != 0)
    starts = np.flatnonzero(is_first)
    turn = np.arange(len(points)) - np.repeat(starts, np.diff(np.append(starts, len(points))))
    kept = by_cell[np.lexsort((by_cell, -response[by_cell], turn))[:count]]
    return kept[strongest(response[kept], count)]
