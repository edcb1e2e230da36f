"""Whether agreement is more than chance."""

import math

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray

_CELLS_PER_DIAGONAL = 32
_CELL_NUMBER = np.array([2.0**20, 1.0])  # of points within half a million cells

MIN_OCCUPIED_CELLS = 8
"""Cells in which the inliers must lie.

With half as many, 14 % of 72 pairs come out wrong instead of 3 %, mostly clusters of wrong matches; with twice as many,
89 % of the solvable ones are found instead of 94 %. The size of the cells and the limit of chance, halved or doubled,
change nothing there.
"""

_MAX_CHANCE = 1e-4  # probability that as many wrong matches agree by chance


def binomial_tail(least: int, trials: int, probability: float) -> float:
    """Probability of ``least`` or more of independent events; SciPy's takes 0.05 to 0.12 s to import."""
    count = np.arange(trials + 1)
    choices = np.append(0.0, np.cumsum(np.log((trials - count[:-1]) / count[1:])))
    logarithm = choices + count * math.log(probability) + (trials - count) * math.log1p(-probability)
    return min(float(np.exp(logarithm[max(least, 0) :]).sum()), 1.0)


def occupied_cells(points1: FloatArray, points2: FloatArray, size1: tuple[int, int], size2: tuple[int, int]) -> int:
    """In how many cells of a grid over each image the matches (N, 2), pixels, lie, where these are fewer."""
    sides = np.array([math.hypot(*size) for size in (size1, size2)]) / _CELLS_PER_DIAGONAL
    cells = np.stack([points1, points2]) / sides[:, None, None]
    numbers = np.sort(np.floor(cells) @ _CELL_NUMBER, axis=1)
    return int((numbers[:, 1:] != numbers[:, :-1]).sum(axis=1).min()) + min(1, len(points1))


def rejection_reason(
    points1: FloatArray,
    points2: FloatArray,
    inliers: NDArray[np.bool_],
    sizes: tuple[tuple[int, int], tuple[int, int]],
    threshold: float,
) -> str | None:
    """Why the inliers (N,) of matches (N, 2), pixels, of images of two sizes could be chance, or None.

    Two tests. Are there more inliers than wrong matches would give by chance? A wrong match lies within
    the threshold, pixels, with a probability of a disc's share of the second image. And do they lie in enough different
    places? Neighbouring matches go wrong together, on a moving object or on a repeated pattern, and count once.
    """
    count = int(inliers.sum())
    cells = occupied_cells(points1[inliers], points2[inliers], *sizes)
    if cells < MIN_OCCUPIED_CELLS:
        if count < MIN_OCCUPIED_CELLS:
            return f"only {count} of {len(inliers)} matches agree"
        return f"{count} of {len(inliers)} matches agree, but they lie in {cells} places of the image only"
    by_chance = min(0.5, np.pi * threshold**2 / math.prod(sizes[1]) + 0.01)
    trials = len(inliers) - 4
    if trials > 0 and binomial_tail(count - 4, trials, by_chance) > _MAX_CHANCE:
        return f"{count} of {len(inliers)} matches agree, no more than chance allows"
    return None
