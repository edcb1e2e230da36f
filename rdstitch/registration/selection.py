"""Which pairs of pictures to look at."""

from itertools import combinations

EXHAUSTIVE_UP_TO = 30
"""Number of pictures up to which every pair is tried; beyond, its cost grows faster than its use."""


def all_pairs(count: int) -> list[tuple[int, int]]:
    """Every pair of ``count`` pictures, (i, j) with i < j."""
    return list(combinations(range(count), 2))
