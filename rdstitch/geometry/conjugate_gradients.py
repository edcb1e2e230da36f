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

    Of a right side of zeros it is a share of the residual at the start. The columns are solved side by side: a product
    with the matrix is most of a step, and one serves them all.
    """
    x, left, ones = start, right - matrix @ start, np.ones(len(right))
    enough = tolerance**2 * np.where(right.any(axis=0), (right**2).sum(axis=0), (left**2).sum(axis=0))
    direction, previous, definite = np.zeros_like(x), np.ones(x.shape[1]), np.ones(x.shape[1], dtype=np.bool_)
    for _ in range(_MAX_STEPS):
        going = definite & (ones @ left**2 > enough)
        if not going.any():
            break
        better = precondition(left)
        now = ones @ (left * better)
        direction = np.where(going, better + now / previous * direction, 0.0)
        along = matrix @ direction
        curvature = ones @ (direction * along)
        definite &= ~going | (curvature > 0.0)  # else nothing better is known than what was reached
        going &= definite
        step = np.where(going, now, 0.0) / np.where(going, curvature, 1.0)
        x, left, previous = x + step * direction, left - step * along, np.where(going, now, 1.0)
    return x
