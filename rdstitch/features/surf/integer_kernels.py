"""Linear filters of 8-bit patches as exact matrix products.

A BLAS sums in an order of its own, which may change with the number of threads. Filters of integers small enough for
all sums to fit float32's 24 bits give the same result in any order.
"""

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray

_MAX_SUM = 2.0**24 / 255 - 1000  # of the absolute values of one filter, with room for rounding


def integer_kernels(kernels: FloatArray) -> tuple[NDArray[np.float32], float]:
    """Round filters of zero sum to integers of zero sum.

    Parameters
    ----------
    kernels : ndarray of shape (pixels, filters)

    Returns
    -------
    rounded : ndarray of shape (pixels, filters), float32
    factor : float
        Divide the products by this.
    """
    factor = float(_MAX_SUM / np.abs(kernels).sum(axis=0).max())
    rounded = np.rint(kernels * factor)
    # What rounding adds to the sum, a handful of units in 65,000, goes to the largest weight.
    rounded[np.abs(rounded).argmax(axis=0), np.arange(kernels.shape[1])] -= rounded.sum(axis=0)
    return rounded.astype(np.float32), factor


def apply(patches: NDArray[np.uint8], kernels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Products of patches (N, side, side) with filters (side², M), exact, shape (N, M)."""
    return patches.reshape(len(patches), -1).astype(np.float32) @ kernels
