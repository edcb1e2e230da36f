"""All real roots of a batch of scalar equations, each inside its own interval.

All minimal problems of this package but that of :func:`rdstitch.solvers.three_point` are one polynomial equation per
sample, in λ or in the focal length. The polynomial is known by its values at Chebyshev nodes of the sample's interval;
one matrix product turns them into Bernstein coefficients on a few cells. By Descartes' rule a cell whose coefficients
never change sign has no root, and one with a single change has exactly one. Cells with more changes are divided until
they are isolated or as good as double; none is missed, as on a grid of samples. Newton's method on the Chebyshev series
finds each root, and its last steps use the equation itself, which is better conditioned than the polynomial through its
values.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Protocol, Self

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.solvers.batch import IndexArray
from rdstitch.solvers.polynomials import (
    bernstein_from_values,
    bernstein_subdivision,
    bernstein_value,
    chebyshev_nodes,
    chebyshev_values,
    value_and_slope_from_values,
)

_VALUES_IN_CACHE = 20480
_CELLS = 8
_EDGES = np.linspace(-1.0, 1.0, _CELLS + 1)
_PARTS = 4
_DEPTH = 6
# Relative to the largest value of the polynomial: what counts as a double root. Values of the polynomial are rounded
# to about 1e-15 of it.
_TOUCHING = 1e-13
_KERNEL_WIDTH = 48
_NEWTON_STEPS = 40
# In units of half the interval. Newton's method squares the error: the next step would be below rounding error.
_NEWTON_CONVERGED = 1e-7
# In the same units. A longer step belongs to a double root, whose slope says nothing.
_MAX_POLISHING_STEP = 1e-2


class Equation(Protocol):
    """One polynomial equation in one unknown for each sample of a batch."""

    def polynomial(self, unknown: FloatArray, /) -> FloatArray:
        """Value of the polynomial, as accurate as possible, for values of the unknown of shape (..., B)."""

    def take(self, samples: IndexArray) -> Self:
        """The equations of some samples; indices may repeat."""


def real_roots(equation: Equation, degree: int, low: FloatArray, high: FloatArray) -> tuple[IndexArray, FloatArray]:
    """All real roots (M,) of each of B equations in its interval, after the equation of each (M,), ascending.

    ``degree`` is that of their polynomials, or more; an interval is empty where ``low < high`` (B,) does not hold.
    """
    half = 0.5 * (high - low)
    middle = low + half
    # With all nodes of all samples at once the intermediate values of an equation would not stay in cache.
    size = max(1, _VALUES_IN_CACHE // (degree + 1))
    series, isolated = np.empty((2, degree + 1, len(half))), []
    for start in range(0, len(half), size):
        part = np.arange(start, min(start + size, len(half)))
        some = equation.take(part) if len(part) < len(half) else equation
        values = some.polynomial(middle[part] + chebyshev_nodes(degree)[:, None] * half[part])
        values[:, ~((half[part] > 0.0) & np.isfinite(values).all(axis=0))] = 1.0
        values = _filled(values)
        series[..., start : start + size] = (value_and_slope_from_values(degree) @ values)[..., : len(part)]
        isolated.append(isolate(values, start))
    if not isolated:
        return np.empty(0, dtype=np.intp), np.empty(0)
    brackets = Brackets.joined(isolated)
    sample = brackets.sample
    t, slope = bracketed_newton(np.take(series, sample, axis=-1), brackets)
    half = half[sample]
    return sample, polish(equation.take(sample), middle[sample] + t * half, slope / half, half)


def polish(equation: Equation, start: FloatArray, slope: FloatArray, half: FloatArray) -> FloatArray:
    """Improve one root (M,) of each equation by two steps on the equation itself, where they do improve it.

    ``slope`` is the derivative of the polynomial there, as far as the values at the nodes tell, ``half`` half the
    length of each interval.
    """
    value = equation.polynomial(start)
    step = value / np.where(slope != 0.0, slope, np.inf)
    step = np.where(np.abs(step) < _MAX_POLISHING_STEP * half, step, 0.0)
    closer = start - step
    remainder = equation.polynomial(closer)
    improved = np.abs(remainder) < np.abs(value)
    # The secant through both values; where they are rounding errors it must not lead away.
    change = value - remainder
    second = step * remainder / np.where(change != 0.0, change, np.inf)
    second = np.where(np.abs(second) < np.abs(step), second, 0.0)
    return np.where(improved, closer - second, start)


@dataclass(frozen=True, eq=False)
class Brackets:
    """Intervals in [-1, 1] that hold one root each, by polynomial."""

    sample: IndexArray  # (M,), intp: polynomial of each root, ascending
    left: FloatArray  # left, right: (M,): ends; equal for a double root, which has no sign change
    right: FloatArray
    value_left: FloatArray  # value_left, value_right: (M,): values of the polynomial there, of opposite signs
    value_right: FloatArray

    @classmethod
    def of_cells(cls, sample: IndexArray, left: FloatArray, width: float, coefficients: FloatArray) -> Self:
        """Whole cells with their Bernstein coefficients (M, degree + 1)."""
        return cls(sample, left, left + width, coefficients[:, 0], coefficients[:, -1])

    @classmethod
    def joined(cls, parts: Sequence["Brackets"], first: int = 0) -> Self:
        """All of them, ascending by sample, whose numbers grow by ``first``."""
        columns = [np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)]
        order = np.argsort(columns[0], kind="stable")
        columns[0] += first
        return cls(*(column[order] for column in columns))


def isolate(values: FloatArray, first: int = 0) -> Brackets:
    """Brackets of all roots in [-1, 1] of polynomials given by their values (degree + 1, B) at Chebyshev nodes.

    The polynomials are numbered from ``first``.
    """
    degree = len(values) - 1
    count = degree + 1
    matrix = bernstein_from_values(degree, _CELLS)
    coefficients = (matrix.reshape(-1, count) @ values).reshape(_CELLS, count, -1)
    positive = coefficients > 0.0
    changes = (positive[:, 1:] != positive[:, :-1]).sum(axis=1, dtype=np.uint8)

    width = 2.0 / _CELLS
    cell, sample = np.nonzero(changes == 1)
    left = _EDGES[cell]
    ends = coefficients[:, [0, -1]][cell, :, sample]
    brackets = [Brackets.of_cells(sample, left, width, ends)]
    cell, sample = np.nonzero(changes > 1)
    left = _EDGES[cell]
    current = coefficients[cell, :, sample]
    split = bernstein_subdivision(degree, _PARTS).reshape(-1, count).T
    for _ in range(_DEPTH):
        if not len(sample):
            break
        width /= _PARTS
        current = (_filled(current.T).T @ split)[: len(current)].reshape(-1, count)
        sample = np.repeat(sample, _PARTS)
        left = (left[:, None] + width * np.arange(_PARTS)).ravel()
        positive = current > 0.0
        changes = (positive[:, 1:] != positive[:, :-1]).sum(axis=1, dtype=np.uint8)
        one, more = changes == 1, changes > 1
        brackets.append(Brackets.of_cells(sample[one], left[one], width, current[one]))
        sample, left, current = sample[more], left[more], current[more]
    if len(sample):
        brackets.append(_close_pairs(current, sample, left, width, np.abs(values).max(axis=0)))
    return Brackets.joined(brackets, first)


def _filled(values: FloatArray) -> FloatArray:
    """Columns (K, B) filled up with ones to a multiple of what the kernels of a matrix product take at once.

    The last columns are otherwise rounded differently, and a sample's roots would depend on the samples beside it.
    """
    return np.pad(values, ((0, 0), (0, -values.shape[1] % _KERNEL_WIDTH)), constant_values=1.0)


def _close_pairs(
    coefficients: FloatArray, sample: IndexArray, left: FloatArray, width: float, largest: FloatArray
) -> Brackets:
    """Roots in cells so narrow that the polynomial, of ``largest`` values (B,), is a parabola there."""
    first, last = coefficients[:, 0], coefficients[:, -1]
    right = left + width
    crosses = (first > 0.0) != (last > 0.0)
    # The middle control point of the parabola with the same end values and mean end slope, and its vertex in [0, 1].
    degree = coefficients.shape[1] - 1
    bend = 0.5 * degree * ((last - coefficients[:, -2]) - (coefficients[:, 1] - first))
    control = 0.5 * (first + last - bend)
    s = np.clip((first - control) / np.where(bend != 0.0, bend, np.inf), 0.0, 1.0)
    vertex = left + s * width
    lowest = bernstein_value(coefficients, s)
    dips = ~crosses & ((lowest > 0.0) != (first > 0.0))
    touches = ~crosses & ~dips & (np.abs(lowest) <= _TOUCHING * largest[sample])
    parts = (
        (crosses, left, right, first, last),
        (dips, left, vertex, first, lowest),
        (dips, vertex, right, lowest, last),
        (touches, vertex, vertex, lowest, lowest),
    )
    return Brackets.joined([Brackets(sample[mask], *(column[mask] for column in columns)) for mask, *columns in parts])


def bracketed_newton(series: FloatArray, brackets: Brackets) -> tuple[FloatArray, FloatArray]:
    """The root of each Chebyshev series in its bracket, and the derivative there; shape (M,).

    Newton's method from where the chord crosses zero; a step that leaves the bracket is replaced by its middle.
    ``series`` (2, degree + 1, M) are those of each polynomial and of its derivative.
    """
    left, right = brackets.left, brackets.right
    change = brackets.value_right - brackets.value_left
    rising = change > 0.0
    t = left - brackets.value_left * (right - left) / np.where(change != 0.0, change, np.inf)
    roots, slopes = t.copy(), np.empty_like(t)
    # What has converged stays as it is, however long the others take.
    active, settled = np.arange(len(t)), np.zeros(len(t), dtype=np.bool_)
    for _ in range(_NEWTON_STEPS):
        value, slope = chebyshev_values(series, t)
        above = (value > 0.0) == rising
        right = np.where(above, t, right)
        left = np.where(above, left, t)
        following = t - value / np.where(slope != 0.0, slope, np.inf)
        following = np.where((following >= left) & (following <= right), following, 0.5 * (left + right))
        roots[active] = np.where(settled, roots[active], following)
        slopes[active] = np.where(settled, slopes[active], slope)
        settled |= np.abs(following - t) <= _NEWTON_CONVERGED
        going = np.flatnonzero(~settled)
        if not len(going):
            break
        if len(going) < 0.7 * len(t):
            active, settled, series = active[going], settled[going], np.take(series, going, axis=-1)
            left, right, rising, following = left[going], right[going], rising[going], following[going]
        t = following
    return roots, slopes
