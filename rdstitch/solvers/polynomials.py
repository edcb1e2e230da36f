"""Polynomials by values at Chebyshev nodes, as Chebyshev series, and in Bernstein form on parts of the interval."""

import math
from functools import lru_cache
from itertools import pairwise

import numpy as np

from rdstitch.arrays import FloatArray, read_only


@lru_cache
def chebyshev_nodes(degree: int) -> FloatArray:
    """Chebyshev nodes of the first kind in [-1, 1], enough for a polynomial of this degree; shape (degree + 1,)."""
    count = degree + 1
    return read_only(np.cos((2 * np.arange(count) + 1) * np.pi / (2 * count)))


@lru_cache
def chebyshev_from_values(degree: int) -> FloatArray:
    """Matrix from values at the Chebyshev nodes to coefficients of the Chebyshev series."""
    count = degree + 1
    angles = (2 * np.arange(count) + 1) * np.pi / (2 * count)
    matrix = 2.0 / count * np.cos(np.arange(count)[:, None] * angles)
    matrix[0] /= 2.0
    return read_only(matrix)


@lru_cache
def value_and_slope_from_values(degree: int) -> FloatArray:
    """Matrices from values at the Chebyshev nodes to the Chebyshev series of a polynomial and of its derivative.

    Shape (2, degree + 1, degree + 1): value and slope, coefficient, node.
    """
    series = chebyshev_from_values(degree)
    slope = np.polynomial.chebyshev.chebder(series)
    return read_only(np.stack([series, np.pad(slope, ((0, len(series) - len(slope)), (0, 0)))]))


def chebyshev_values(series: FloatArray, t: FloatArray) -> FloatArray:
    """Values at t (N,) of Chebyshev series (S, degree + 1, N), S at each place; shape (S, N)."""
    # Term by term and in place: this is the innermost loop of all solvers, and a sum of products by einsum is rounded
    # differently at the end of an array, so that a root would depend on the number of others.
    twice, before, current = 2.0 * t, np.ones_like(t), t
    total = series[:, 1] * t if series.shape[1] > 1 else np.zeros_like(series[:, 0])
    total += series[:, 0]
    for k in range(2, series.shape[1]):
        following = twice * current
        following -= before
        before, current = current, following
        total += series[:, k] * following
    return np.asarray(total)


@lru_cache
def bernstein_from_values(degree: int, cells: int) -> FloatArray:
    """Matrix from values at the Chebyshev nodes to Bernstein coefficients on equal cells of [-1, 1].

    Shape (cells, degree + 1, degree + 1): cell, coefficient, node. Coefficient j on the cell [a, b] is the blossom of
    the polynomial at ``degree - j`` times a and j times b. That of a Lagrange polynomial ``Π (t - t_m) / Π (t_k -
    t_m)`` is coefficient j of ``Π ((a - t_m) + (b - t_m) z)`` over the binomial: a product whose factors, but for nodes
    inside the cell, do not cancel.
    """
    nodes = chebyshev_nodes(degree)
    edges = np.linspace(-1.0, 1.0, cells + 1)
    count = degree + 1
    matrix = np.empty((cells, count, count))
    binomials = _binomials(degree)
    for cell, (a, b) in enumerate(pairwise(edges)):
        for k in range(count):
            others = np.delete(nodes, k)
            product = np.ones(1)
            for node in others:
                product = np.convolve(product, (a - node, b - node))
            matrix[cell, :, k] = product / binomials / np.prod(nodes[k] - others)
    return read_only(matrix)


@lru_cache
def bernstein_subdivision(degree: int, parts: int) -> FloatArray:
    """Matrix from Bernstein coefficients on a cell to those on its equal parts, by part, new and old."""
    edges = np.linspace(0.0, 1.0, parts + 1)
    matrix = np.empty((parts, degree + 1, degree + 1))
    for part, (a, b) in enumerate(pairwise(edges)):
        for j in range(degree + 1):
            product = np.ones(1)
            for _ in range(degree - j):
                product = np.convolve(product, (1.0 - a, a))
            for _ in range(j):
                product = np.convolve(product, (1.0 - b, b))
            matrix[part, j] = product
    return read_only(matrix)


def bernstein_value(coefficients: FloatArray, s: FloatArray) -> FloatArray:
    """Values at s in [0, 1], (N,), of polynomials with Bernstein coefficients (N, degree + 1)."""
    degree = coefficients.shape[1] - 1
    j = np.arange(degree + 1)
    weights = _binomials(degree) * s[:, None] ** j * (1.0 - s[:, None]) ** (degree - j)
    return np.asarray(np.einsum("nj,nj->n", coefficients, weights))


@lru_cache
def _binomials(degree: int) -> FloatArray:
    """``C(degree, j)`` for all j."""
    return read_only(np.array([math.comb(degree, j) for j in range(degree + 1)], dtype=np.float64))
