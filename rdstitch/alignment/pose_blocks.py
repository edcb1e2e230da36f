"""Which poses the links couple: the pattern of the sparse normal matrix, the same at every step of an adjustment."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from rdstitch.alignment.observations import Observations
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.late_imports import sparse


@dataclass(frozen=True, eq=False)
class PoseBlocks:
    """The normal matrix of F free pose parameters, put together from blocks of L links.

    Attributes
    ----------
    column : ndarray of shape (L, 2 D)
        Which of the free parameters those of the link's two images are; F for those that are not free.
    free : int
        F.
    kept : ndarray of shape (L, 2 D, 2 D), bool
        Entries of the links' blocks between free parameters.
    place : ndarray of shape (K,)
        Where each of these is added in the E entries of the matrix.
    indices, indptr : ndarray
        Of the matrix by columns; all of its diagonal is stored.
    diagonal : ndarray of shape (F,)
        Where the diagonal lies in the entries.
    """

    column: IntArray
    free: int
    kept: BoolArray
    place: IntArray
    indices: IntArray
    indptr: IntArray
    diagonal: IntArray

    @classmethod
    def of(cls, observations: Observations, free: BoolArray) -> Self:
        """Of links between N images, whose parameters (N, D) may move where ``free``."""
        total = int(free.sum())
        number = np.where(free, np.cumsum(free.reshape(-1)).reshape(free.shape) - 1, total)
        column = np.concatenate([number[observations.image1], number[observations.image2]], axis=1)
        across, down = np.broadcast_arrays(column[:, None, :], column[:, :, None])
        kept = (across < total) & (down < total)
        of_diagonal = np.arange(total) * (total + 1)
        entries, place = np.unique(
            np.concatenate([across[kept] * total + down[kept], of_diagonal]), return_inverse=True
        )
        own, diagonal = np.split(place.reshape(-1), [int(kept.sum())])
        indptr = np.searchsorted(entries, np.arange(total + 1) * total)
        indices = entries % max(total, 1)
        return cls(column, total, kept, own, indices.astype(np.int32), indptr.astype(np.int32), diagonal)

    def entries(self, local: FloatArray) -> FloatArray:
        """Entries of the matrix (E,) that is the sum of blocks (L, 2 D, 2 D)."""
        return np.bincount(self.place, local[self.kept], minlength=len(self.indices)).astype(np.float64)

    def with_diagonal(self, entries: FloatArray, added: FloatArray) -> FloatArray:
        """The entries (E,) with something (F,) added to the diagonal."""
        entries = entries.copy()
        entries[self.diagonal] += added
        return entries

    def matrix(self, entries: FloatArray) -> "sparse.csc_array":
        """The matrix of some entries (E,)."""
        return sparse.csc_array((entries, self.indices, self.indptr), shape=(self.free, self.free))

    def sums(self, values: FloatArray) -> FloatArray:
        """Of values (L, 2 D, ...) of each link the sum for each free parameter, (F, ...)."""
        total = np.zeros((self.free + 1, *values.shape[2:]))
        np.add.at(total, self.column, values)
        return total[:-1]
