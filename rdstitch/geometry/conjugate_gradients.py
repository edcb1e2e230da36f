"""Conjugate gradients for large symmetric systems, of which a good guess at the inverse is known."""

from collections.abc import Callable
from typing import Any

import numpy as np

from rdstitch.arrays import FloatArray

_MAX_STEPS = 3000


def conjugate_gradients(
    matrix: Any,
    right: FloatArray,
    start: FloatArray,
    precondition: Callable[[FloatArray], FloatArray],
    tolerance: float,
) -> FloatArray:
    """The solution (K, C) of ``matrix x = right`` up to a residual, as a share of the right side.

    The columns are solved side by side: a product with the matrix is most of a step, and one serves them all.
    """
    x, left, ones = start, right - matrix @ start, np.ones(len(right))
    enough = tolerance**2 * (right**2).sum(axis=0)
    direction, previous = np.zeros_like(x), np.ones(x.shape[1])
    for _ in range(_MAX_STEPS):
        going = ones @ left**2 > enough
        if not going.any():
            break
        better = precondition(left)
        now = ones @ (left * better)
        direction = better + now / previous * direction
        along = matrix @ direction
        step = np.where(going, now, 0.0) / np.where(going, ones @ (direction * along), 1.0)
        x, left, previous = x + step * direction, left - step * along, np.where(going, now, 1.0)
    return x
