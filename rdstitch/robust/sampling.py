"""Drawing minimal samples: uniformly, or the most promising correspondences first (PROSAC)."""

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray

IndexArray = NDArray[np.intp]


class Sampler:
    """Draws batches of samples of distinct correspondences.

    With a quality for each correspondence every other sample is a PROSAC sample (Chum and Matas 2005): it is drawn
    from the best n correspondences, where n grows with the number of samples until it comprises all. The samples
    between are uniform, so that a misleading quality costs no more than a factor of two.

    Parameters
    ----------
    count : int
        Number of correspondences.
    sample_size : int
        Correspondences in one sample, at most ``count``.
    quality : ndarray of shape (count,) or None
        The higher the better.
    growth : int
        Number of samples after which PROSAC draws from all correspondences.
    seed : int or sequence of int
    """

    def __init__(
        self, count: int, sample_size: int, quality: FloatArray | None, growth: int, seed: int | list[int]
    ) -> None:
        self._random = np.random.default_rng(seed)
        self._sample_size = sample_size
        self._count = count
        self._drawn = 0
        self._order = None if quality is None else np.argsort(-quality, kind="stable")
        pool = np.arange(sample_size, count + 1)
        share = np.ones(len(pool))
        for i in range(sample_size):
            share *= (pool - i) / (count - i)
        self._last_of_pool = np.maximum(growth * share, 1.0)
        self._last_of_pool[-1] = np.inf

    def draw(self, batch: int) -> IndexArray:
        """Indices of the next ``batch`` samples, shape (batch, sample_size)."""
        pool = np.full(batch, self._count)
        if self._order is not None:
            number = self._drawn + np.arange(0, batch, 2) + 1
            pool[::2] = np.searchsorted(self._last_of_pool, number) + self._sample_size
        self._drawn += batch
        picks = self._distinct(pool)
        if self._order is not None:
            picks[::2] = self._order[picks[::2]]
        return picks

    def _distinct(self, pool: IndexArray) -> IndexArray:
        """For each row, ``sample_size`` distinct integers below ``pool``, uniformly."""
        picks = np.empty((len(pool), self._sample_size), dtype=np.intp)
        for i in range(self._sample_size):
            pick = self._random.integers(0, pool - i)
            for earlier in np.sort(picks[:, :i], axis=1).T:
                pick = pick + (pick >= earlier)
            picks[:, i] = pick
        return picks
