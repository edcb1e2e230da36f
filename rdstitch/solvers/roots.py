"""All real roots of a batch of scalar equations, each inside its own interval.

Every minimal problem of this package is one polynomial equation in λ per sample. The polynomial is known by its values
at Chebyshev nodes of the sample's interval; one matrix product turns them into Bernstein coefficients on a few cells.
By Descartes' rule a cell whose coefficients never change sign has no root, and one with a single change has exactly
one. Cells with more changes are halved until they are isolated or as good as double; none is missed, as on a grid of
samples. Each root is then polished on the equation itself, which is better conditioned than the polynomial
through its values.
"""

from functools import lru_cache
from itertools import pairwise
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.camera import FloatArray

IndexArray = NDArray[np.intp]

_CELLS = 8
_PARTS = 4
_DEPTH = 6
# Relative to the largest value of the polynomial: what counts as a double root. Values of the polynomial are rounded
# to about 1e-15 of it.
_TOUCHING = 1e-13
_POLISHING_STEPS = 12


class Equation(Protocol):
    """One scalar equation in λ for each sample of a batch."""

    def polynomial(self, distortion: FloatArray) -> FloatArray:
        """Value of the polynomial for λ of shape (..., B)."""

    def residual(self, distortion: FloatArray) -> FloatArray:
        """A value with the same sign as the polynomial inside the interval, as well conditioned as possible."""

    def take(self, samples: IndexArray) -> Self:
        """The equations of some samples; indices may repeat."""


def real_roots(equation: Equation, degree: int, low: FloatArray, high: FloatArray) -> tuple[IndexArray, FloatArray]:
    """All real roots of each equation in its interval.

    Parameters
    ----------
    equation : Equation
        B equations.
    degree : int
        Degree of their polynomials, or more.
    low, high : ndarray of shape (B,)
        Interval of each; empty where ``low < high`` does not hold.

    Returns
    -------
    sample : ndarray of shape (M,), intp
        Equation of each root, ascending.
    root : ndarray of shape (M,)
    """
    half = 0.5 * (high - low)
    middle = low + half
    nodes = chebyshev_nodes(degree)
    values = equation.polynomial(middle + nodes[:, None] * half)
    largest = np.abs(values).max(axis=0)
    values[:, ~((half > 0.0) & np.isfinite(largest))] = 1.0
    sample, left, right, known = isolate(values, largest)
    left = middle[sample] + left * half[sample]
    right = middle[sample] + right * half[sample]
    root = polish(equation.take(sample), left, right)
    root[known] = left[known]
    return sample, root


@lru_cache
def chebyshev_nodes(degree: int) -> FloatArray:
    """Chebyshev nodes of the first kind in [-1, 1], enough for a polynomial of this degree; shape (degree + 1,)."""
    count = degree + 1
    return np.cos((2 * np.arange(count) + 1) * np.pi / (2 * count))


@lru_cache
def bernstein_from_values(degree: int, cells: int) -> FloatArray:
    """Matrix from values at the Chebyshev nodes to Bernstein coefficients on equal cells of [-1, 1].

    Coefficient j on the cell [a, b] is the blossom of the polynomial at ``degree - j`` times a and j times b. That of a
    Lagrange polynomial ``Π (t - t_m) / Π (t_k - t_m)`` is coefficient j of ``Π ((a - t_m) + (b - t_m) z)``
    over the binomial: a product whose factors, but for nodes inside the cell, do not cancel.

    Returns
    -------
    ndarray of shape (cells, degree + 1, degree + 1)
        Cell, coefficient, node.
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
    return matrix


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
    return matrix


def isolate(values: FloatArray, largest: FloatArray) -> tuple[IndexArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Brackets of all roots in [-1, 1] of polynomials given by their values at Chebyshev nodes.

    Parameters
    ----------
    values : ndarray of shape (degree + 1, B)
    largest : ndarray of shape (B,)
        Size of the values, the yardstick of what counts as zero.

    Returns
    -------
    sample : ndarray of shape (M,), intp
        Polynomial of each root, ascending.
    left, right : ndarray of shape (M,)
        Interval that holds exactly one root.
    known : ndarray of shape (M,), bool
        Double roots, which have no sign change: found already, at ``left``.
    """
    degree = len(values) - 1
    count = degree + 1
    matrix = bernstein_from_values(degree, _CELLS)
    coefficients = (matrix.reshape(-1, count) @ values).reshape(_CELLS, count, -1)
    positive = coefficients > 0.0
    changes = (positive[:, 1:] != positive[:, :-1]).sum(axis=1, dtype=np.uint8)

    width = 2.0 / _CELLS
    cell, sample = np.nonzero(changes == 1)
    found = [(sample, width * cell - 1.0, width * (cell + 1) - 1.0)]
    cell, sample = np.nonzero(changes > 1)
    left = np.asarray(width * cell - 1.0, dtype=np.float64)
    current = coefficients[cell, :, sample]
    split = bernstein_subdivision(degree, _PARTS).reshape(-1, count).T
    for _ in range(_DEPTH):
        if not len(sample):
            break
        width /= _PARTS
        current = (current @ split).reshape(-1, count)
        sample = np.repeat(sample, _PARTS)
        left = (left[:, None] + width * np.arange(_PARTS)).ravel()
        positive = current > 0.0
        changes = (positive[:, 1:] != positive[:, :-1]).sum(axis=1, dtype=np.uint8)
        one, more = changes == 1, changes > 1
        found.append((sample[one], left[one], left[one] + width))
        sample, left, current = sample[more], left[more], current[more]

    samples, lefts, rights = (np.concatenate(parts) for parts in zip(*found, strict=True))
    known = np.zeros(len(samples), dtype=np.bool_)
    if len(sample):
        close = _close_pairs(current, sample, left, width, largest)
        samples, lefts, rights, known = (
            np.concatenate(pair) for pair in zip((samples, lefts, rights, known), close, strict=True)
        )
    order = np.lexsort((lefts, samples))
    return samples[order], lefts[order], rights[order], known[order]


def _close_pairs(
    coefficients: FloatArray, sample: IndexArray, left: FloatArray, width: float, largest: FloatArray
) -> tuple[IndexArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Roots of cells so narrow that the polynomial is a parabola there; same values as :func:`isolate`."""
    first, last = coefficients[:, 0], coefficients[:, -1]
    right = left + width
    crosses = (first > 0.0) != (last > 0.0)
    # The parabola with the end slopes of the cell, c0 (1-s)² + 2 m s (1-s) + c2 s², has its vertex at s.
    degree = coefficients.shape[1] - 1
    control = 0.5 * (first + last) + 0.25 * degree * ((coefficients[:, 1] - first) - (last - coefficients[:, -2]))
    bend = first - 2.0 * control + last
    s = np.clip((first - control) / np.where(bend != 0.0, bend, np.inf), 0.0, 1.0)
    vertex = left + s * width
    lowest = bernstein_value(coefficients, s)
    dips = ~crosses & ((lowest > 0.0) != (first > 0.0))
    touches = ~crosses & ~dips & (np.abs(lowest) <= _TOUCHING * largest[sample])
    return (
        np.concatenate([sample[crosses], sample[dips], sample[dips], sample[touches]]),
        np.concatenate([left[crosses], left[dips], vertex[dips], vertex[touches]]),
        np.concatenate([right[crosses], vertex[dips], right[dips], vertex[touches]]),
        np.repeat([False, True], [crosses.sum() + 2 * dips.sum(), touches.sum()]),
    )


@lru_cache
def _binomials(degree: int) -> FloatArray:
    """``C(degree, j)`` for all j."""
    row = np.ones(1)
    for _ in range(degree):
        row = np.convolve(row, (1.0, 1.0))
    return row


def bernstein_value(coefficients: FloatArray, s: FloatArray) -> FloatArray:
    """Values at s in [0, 1], (N,), of polynomials with Bernstein coefficients (N, degree + 1)."""
    degree = coefficients.shape[1] - 1
    j = np.arange(degree + 1)
    weights = _binomials(degree) * s[:, None] ** j * (1.0 - s[:, None]) ** (degree - j)
    return np.asarray(np.einsum("nj,nj->n", coefficients, weights))


def polish(equation: Equation, left: FloatArray, right: FloatArray) -> FloatArray:
    """Roots of the residuals in brackets, to rounding error: regula falsi with the weights of Anderson and Björck.

    Parameters
    ----------
    equation : Equation
        M equations.
    left, right : ndarray of shape (M,)
        Interval of each that holds one root.

    Returns
    -------
    ndarray of shape (M,)
    """
    a, b = left.copy(), right.copy()
    fa, fb = equation.residual(a), equation.residual(b)
    root = np.where(np.abs(fa) < np.abs(fb), a, b)
    for _ in range(_POLISHING_STEPS):
        slope = fb - fa
        step = np.where(slope != 0.0, fb * (b - a) / np.where(slope != 0.0, slope, 1.0), 0.0)
        previous = root
        root = b - step
        value = equation.residual(root)
        if not np.any(np.abs(root - previous) > 1e-15 * np.abs(root)):
            break
        switch = (value > 0.0) != (fb > 0.0)
        weight = 1.0 - value / np.where(fb != 0.0, fb, 1.0)
        fa = np.where(switch, fb, fa * np.where(weight > 0.0, weight, 0.5))
        a = np.where(switch, b, a)
        b, fb = root, value
    return np.clip(root, left, right)
