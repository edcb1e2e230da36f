"""Whether agreement is more than chance."""

import math

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray

_CELLS_PER_DIAGONAL = 32
_CELL_STRIDE = 2.0**20

MIN_PLACES = 8
"""Cells in which the inliers must lie.

With half as many, 14 % of 72 pairs come out wrong instead of 3 %, mostly clusters of wrong matches; with twice as many,
89 % of the solvable ones are found instead of 94 %. The size of
the cells and the limit of chance, halved or doubled, change nothing there.
"""

_MAX_CHANCE = 1e-4  # probability that as many wrong matches agree by chance


def places(points1: FloatArray, points2: FloatArray, image_size: tuple[int, int]) -> int:
    """In how many cells of a grid the matches (N, 2), pixels, lie, in the image in which these are fewer."""
    cell = float(np.hypot(*image_size)) / _CELLS_PER_DIAGONAL
    return min(len(set(numbered_cells(points / cell).tolist())) for points in (points1, points2))


def numbered_cells(points: FloatArray) -> FloatArray:
    """A number for the cell of the unit grid that each point (N, 2) lies in, of points within half a million cells."""
    column, row = np.floor(points).T
    numbers: FloatArray = column * _CELL_STRIDE + row
    return numbers


def binomial_tail(least: int, trials: int, probability: float) -> float:
    """Probability that ``least`` or more of independent events happen, each with a probability in (0, 1)."""
    if least <= 0:
        return 1.0
    first = math.lgamma(trials + 1) - math.lgamma(least + 1) - math.lgamma(trials - least + 1)
    first += least * math.log(probability) + (trials - least) * math.log1p(-probability)
    happened = np.arange(least, trials)
    odds = probability / (1.0 - probability)
    ratios = (trials - happened) / (happened + 1.0) * odds  # of each term to the one before
    return math.exp(first) + float(np.exp(first + np.cumsum(np.log(ratios))).sum())


def rejection_reason(
    points1: FloatArray, points2: FloatArray, inliers: NDArray[np.bool_], image_size: tuple[int, int], threshold: float
) -> str | None:
    """Why the inliers could be chance, or None.

    Two tests. Are there more inliers than wrong matches would give by chance? A wrong match lies within
    the threshold with a probability of a disc's share of the image. And do they lie in enough different places?
    Neighbouring matches go wrong together, on a moving object or on a repeated pattern, and count once.

    Parameters
    ----------
    points1, points2 : ndarray of shape (N, 2)
        Measured points, pixels.
    inliers : ndarray of shape (N,), bool
    image_size : (int, int)
        Of image 2, pixels.
    threshold : float
        pixels.
    """
    count = int(inliers.sum())
    cells = places(points1[inliers], points2[inliers], image_size)
    if cells < MIN_PLACES:
        if count < MIN_PLACES:
            return f"only {count} of {len(inliers)} matches agree"
        return f"{count} of {len(inliers)} matches agree, but they lie in {cells} places of the image only"
    by_chance = min(0.5, np.pi * threshold**2 / (image_size[0] * image_size[1]) + 0.01)
    trials = len(inliers) - 4
    if trials > 0 and binomial_tail(count - 4, trials, by_chance) > _MAX_CHANCE:
        return f"{count} of {len(inliers)} matches agree, no more than chance allows"
    return None
