"""Drawing minimal samples of many pairs: uniformly, or the most promising matches first (PROSAC)."""

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray


class Sampler:
    """Draws batches of samples of distinct matches, for many pairs in parallel.

    Where the matches of a pair are ordered by quality, every other sample is a PROSAC sample (Chum and Matas 2005): it
    is drawn from the best n matches, where n grows with the number of samples until it comprises all. The samples
    between are uniform, so that a misleading quality costs no more than a factor of two.

    All pairs share one stream of random numbers, so that what a pair draws depends on no other pair, nor on the size of
    the batches.

    ``sample_size``: matches in one sample; ``growth``: number of samples after which PROSAC draws from all matches.
    """

    def __init__(self, sample_size: int, growth: int, seed: int | list[int]) -> None:
        self._random = np.random.default_rng(seed)
        self._numbers = np.empty((0, sample_size))
        self._growth = growth

    def draw(self, start: IntArray, batch: int, counts: IntArray, ordered: BoolArray) -> IntArray:
        """Places in each pair of the matches of some of its samples, shape (B, batch, sample_size).

        ``start`` (B,): number of the first sample of each pair; ``batch``: samples of each pair; ``counts`` (B,):
        matches of each pair, at least ``sample_size``; ``ordered`` (B,) bool: whether its best matches come first.
        """
        sample_size = self._numbers.shape[1]
        missing = int(start.max(initial=0)) + batch - len(self._numbers)
        if missing > 0:
            self._numbers = np.concatenate([self._numbers, self._random.random((missing, sample_size))])
        number = start[:, None] + np.arange(batch)
        # The samples from the best n of N matches are a fraction (n / N)^k of all: so n grows by the k-th root.
        fraction = np.minimum((number + 1) / self._growth, 1.0) ** (1.0 / sample_size)
        grown = np.clip(np.ceil(counts[:, None] * fraction).astype(np.intp), sample_size, counts[:, None])
        return _distinct(self._numbers[number], np.where(ordered[:, None] & (number % 2 == 0), grown, counts[:, None]))


def _distinct(numbers: FloatArray, pool: IntArray) -> IntArray:
    """Turn numbers in [0, 1) of each sample (B, S) into as many distinct integers below its ``pool``."""
    picks = np.empty(numbers.shape, dtype=np.intp)
    for i in range(numbers.shape[-1]):
        pick = (numbers[..., i] * (pool - i)).astype(np.intp)
        for earlier in np.moveaxis(np.sort(picks[..., :i], axis=-1), -1, 0):
            pick += pick >= earlier
        picks[..., i] = pick
    return picks
