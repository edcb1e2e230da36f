"""Conjugate gradients for large symmetric systems, of which a good guess at the inverse is known."""

import itertools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np

from rdstitch.arrays import FloatArray

_MAX_STEPS = 3000
_SHARED_FROM = 200_000
"""Entries of a matrix from which on threads share a product with three columns: it takes 0.9 ms then, and handing
parts of it to threads 0.2 to 0.4 ms."""


def conjugate_gradients(
    matrix: Any,
    right: FloatArray,
    start: FloatArray,
    precondition: Callable[[FloatArray], FloatArray],
    tolerance: float,
    workers: int = 1,
) -> FloatArray:
    """The solution (K, C) of ``matrix x = right`` up to a residual, as a share of the right side.

    Of a right side of zeros it is a share of the residual at the start. The columns are solved side by side: a product
    with the matrix is most of a step, and one serves them all. ``workers``: threads that share it; the solution is the
    same, bit for bit, for any number of them.
    """
    with _product(matrix, workers) as multiply:
        return _solved(multiply, right, start, precondition, tolerance)


@contextmanager
def _product(matrix: Any, workers: int) -> Iterator[Callable[[FloatArray], FloatArray]]:
    """The product with a matrix: of a large sparse one, each thread computes some of the rows."""
    if workers == 1 or getattr(matrix, "nnz", 0) < _SHARED_FROM:
        yield matrix.__matmul__
        return
    ends = np.linspace(0, matrix.shape[0], workers + 1).astype(np.intp)
    parts = [matrix[start:end] for start, end in itertools.pairwise(ends)]
    with ThreadPoolExecutor(workers) as pool:
        yield lambda x: np.concatenate(list(pool.map(lambda part: part @ x, parts)))


def _solved(
    multiply: Callable[[FloatArray], FloatArray],
    right: FloatArray,
    start: FloatArray,
    precondition: Callable[[FloatArray], FloatArray],
    tolerance: float,
) -> FloatArray:
    """See :func:`conjugate_gradients`."""
    x, residual, ones = start, right - multiply(start), np.ones(len(right))
    limit = tolerance**2 * np.where(right.any(axis=0), (right**2).sum(axis=0), (residual**2).sum(axis=0))
    direction, previous, definite = np.zeros_like(x), np.ones(x.shape[1]), np.ones(x.shape[1], dtype=np.bool_)
    for _ in range(_MAX_STEPS):
        active = definite & (ones @ residual**2 > limit)
        if not active.any():
            break
        preconditioned = precondition(residual)
        product = ones @ (residual * preconditioned)
        direction = np.where(active, preconditioned + product / previous * direction, 0.0)
        moved = multiply(direction)
        curvature = ones @ (direction * moved)
        definite &= ~active | (curvature > 0.0)  # else nothing better is known than what was reached
        active &= definite
        step = np.where(active, product, 0.0) / np.where(active, curvature, 1.0)
        x, residual, previous = x + step * direction, residual - step * moved, np.where(active, product, 1.0)
    return x
