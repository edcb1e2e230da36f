"""How alike descriptors are, in blocks, as exact numbers: larger is more alike, and equal means equal.

Floating-point sums depend on the order of summation, hence on block sizes and threads. Here all terms are
integers small enough for every partial sum to be exact, so there is nothing to depend on.
"""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features.keypoints import Descriptors

# |a|² + |b|² and 2 a·b then stay below 2²³, where float32 still knows halves.
_MAX_NORM = 1024.0


class Similarity(Protocol):
    """Compares descriptors of picture 1 with all descriptors of picture 2."""

    lowest: float
    """Less than any similarity."""
    dtype: np.dtype[Any]
    """Type of a similarity."""
    bytes_each: int
    """Memory that one similarity takes while it is made."""

    def block(self, rows: NDArray[np.intp]) -> NDArray[Any]:
        """Similarities of some descriptors of picture 1 to all of picture 2, shape (len(rows), count 2).

        Valid until the next call, which overwrites them.
        """
        ...

    def pairs(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[Any]:
        """Similarities of single pairs of descriptors, shape (len(rows),)."""
        ...

    def distance(self, similarity: NDArray[Any]) -> FloatArray:
        """The distance that a similarity stands for; infinite for ``lowest``."""
        ...


class Euclidean:
    """``-d²/2`` of float descriptors, one matrix product a block.

    SIFT's and RootSIFT's are integers as they come; others are rounded to a grid of at most 1/512 of the largest
    norm. With the products of ``(a, 1, -|a|²/2)`` and ``(b, -|b|²/2, 1)`` the BLAS does all the work.
    """

    lowest = -np.inf
    dtype = np.dtype(np.float32)
    bytes_each = 4

    def __init__(self, descriptors1: NDArray[np.float32], descriptors2: NDArray[np.float32]) -> None:
        norms = (float(np.linalg.norm(d, axis=1).max(initial=0.0)) for d in (descriptors1, descriptors2))
        largest = max(norms)
        # A power of two, so that integers stay integers.
        scale = np.float32(2.0 ** np.floor(np.log2(_MAX_NORM / largest)) if largest > 0 else 1.0)
        a, b = np.rint(descriptors1 * scale), np.rint(descriptors2 * scale)
        half_a, half_b = (np.einsum("ij,ij->i", v, v)[:, None] / np.float32(2.0) for v in (a, b))
        self._left = np.hstack([a, np.ones_like(half_a), -half_a])
        self._right = np.ascontiguousarray(np.hstack([b, -half_b, np.ones_like(half_b)]).T)
        self._block = np.empty((0, self._right.shape[1]), np.float32)

    def block(self, rows: NDArray[np.intp]) -> NDArray[Any]:
        """See :class:`Similarity`."""
        # Fresh memory for every block would cost a fifth of the time.
        if len(self._block) < len(rows):
            self._block = np.empty((len(rows), self._right.shape[1]), np.float32)
        return np.matmul(self._left[rows], self._right, out=self._block[: len(rows)])

    def pairs(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[Any]:
        """See :class:`Similarity`."""
        return np.einsum("ij,ij->i", self._left[rows], self._right.T[columns])  # type: ignore[no-any-return]

    def distance(self, similarity: NDArray[Any]) -> FloatArray:
        """See :class:`Similarity`."""
        return np.sqrt(-2.0 * similarity.astype(np.float64))


class Hamming:
    """Number of equal bits of binary descriptors, counted 64 at a time."""

    lowest = -1.0
    dtype = np.dtype(np.int16)
    bytes_each = 8 + 1 + 2

    def __init__(self, descriptors1: NDArray[np.uint8], descriptors2: NDArray[np.uint8]) -> None:
        self._bits = 64 * -(-descriptors1.shape[1] // 8)
        # Equal bits of a and b are the ones of a ^ ~b.
        self._left = _words(descriptors1)
        self._right = np.ascontiguousarray(~_words(descriptors2).T)

    def block(self, rows: NDArray[np.intp]) -> NDArray[Any]:
        """See :class:`Similarity`."""
        shape = (len(rows), self._right.shape[1])
        total, equal, count = np.zeros(shape, np.int16), np.empty(shape, np.uint64), np.empty(shape, np.uint8)
        for left, right in zip(self._left[rows].T, self._right, strict=True):
            np.bitwise_xor(left[:, None], right, out=equal)
            np.bitwise_count(equal, out=count)
            np.add(total, count, out=total)
        return total

    def pairs(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[Any]:
        """See :class:`Similarity`."""
        equal = np.bitwise_count(self._left[rows] ^ self._right.T[columns])
        total: NDArray[np.int16] = equal.sum(axis=1, dtype=np.int16)
        return total

    def distance(self, similarity: NDArray[Any]) -> FloatArray:
        """See :class:`Similarity`."""
        return np.where(similarity == self.lowest, np.inf, self._bits - similarity.astype(np.float64))


def compare(descriptors1: Descriptors, descriptors2: Descriptors) -> Similarity:
    """The similarity that fits the type of the descriptors."""
    if descriptors1.dtype == np.uint8:
        return Hamming(descriptors1.astype(np.uint8), descriptors2.astype(np.uint8))
    return Euclidean(descriptors1.astype(np.float32), descriptors2.astype(np.float32))


def _words(descriptors: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Bytes as words of 64 bits, filled up with zeros."""
    padded = np.pad(descriptors, ((0, 0), (0, -descriptors.shape[1] % 8)))
    return np.ascontiguousarray(padded).view(np.uint64)
