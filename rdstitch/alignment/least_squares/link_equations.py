"""Transfer errors of the adjustment, linearized: one small Gram matrix per link.

A correspondence depends on the homography of its link (9 entries) and the lens (up to 5 parameters) only. So all it
contributes is summed up in a small matrix per link, whatever the motion model.

With ``z = H p`` the derivative by H is ``(∂d/∂z) ⊗ p``. So products of the derivatives by z and by the lens, times
products of the coordinates of p, are all that is summed: no Jacobian is formed.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.division_model import is_one_to_one
from rdstitch.geometry.radial_homography import (
    TransferJacobian,
    measurement_whitening,
    transfer_jacobian,
    transfer_points,
    whiten,
)
from rdstitch.numerics.robust_loss import robust_weight


@dataclass(frozen=True, eq=False)
class LinkEquations:
    """Weighted, linearized transfer errors of all correspondences, summed per link."""

    gram: FloatArray  # (L, 9 + K, 9 + K): ``Σ w J'J`` by the entries of H and the K free parameters of the lens
    gradient: FloatArray  # (L, 9 + K): ``Σ w J'r``
    whitening: FloatArray  # (M, 2, 2): what makes r of an error in normalized coordinates
    errors: FloatArray  # (M, 2): whitened, pixels; NaN where there is no transfer


class Lens(NamedTuple):
    """The parameters of a lens, half-diagonal frame."""

    distortion: float  # λ
    higher: tuple[float, ...]  # μ and ν; nothing where both are 0
    center: FloatArray  # (2,): the distortion centre, from that of the camera


def split_lens(parameters: FloatArray) -> Lens:
    """Split values of :data:`LENS_PARAMETERS` (5,)."""
    distortion, *higher = parameters[:3].tolist()
    return Lens(distortion, tuple(higher) if any(higher) else (), parameters[3:])


def folds(lens: FloatArray, reach: float = 1.0) -> bool:
    """Whether a lens with more than λ would show a place twice, out to a radius in half diagonals."""
    distortion, higher, center = split_lens(lens)
    return bool(higher) and not is_one_to_one(reach + float(np.linalg.norm(center)), distortion, higher)


@np.errstate(all="ignore")  # a long step may give homographies that are not finite
def link_equations(
    observations: Observations, homographies: FloatArray, lens: FloatArray, width: float, free_lens: BoolArray
) -> LinkEquations:
    """Linearize all transfer errors, by the homographies (L, 3, 3) of the links and the free parameters of the lens.

    The weights are those of :func:`robust_weight`, with this width in pixels.
    """
    count, total = len(observations.points1), 10 + int(free_lens.sum())
    sums = np.zeros((len(observations), total, total))
    errors, whitening = np.empty((2, count)), np.empty((2, 2, count))
    for first, last in observations.chunks:
        rows = slice(observations.start[first], observations.start[last])
        transferred = _transferred(observations, homographies, lens, first, last)
        errors[:, rows], whitening[:, :, rows] = transferred.whitened, transferred.whitening.transpose(1, 2, 0)
        root = np.sqrt(robust_weight(squared_lengths(transferred.whitened.T), width))
        edges = observations.start[first : last + 1] - observations.start[first]
        sums[first:last] = _link_sums(transferred, root, free_lens, edges)
    return LinkEquations(sums[:, :-1, :-1], sums[:, :-1, -1], whitening.transpose(2, 0, 1), errors.T)


def whitened_errors(observations: Observations, homographies: FloatArray, lens: FloatArray) -> FloatArray:
    """Whitened transfer errors of all correspondences, pixels, shape (M, 2); NaN where there is none."""
    chunks = observations.chunks
    errors = [_transferred(observations, homographies, lens, *chunk).whitened for chunk in chunks]
    return np.concatenate([np.empty((2, 0)), *errors], axis=1).T


@np.errstate(all="ignore")
def trial_errors(
    observations: Observations, homographies: FloatArray, lens: FloatArray, whitening: FloatArray
) -> FloatArray:
    """Transfer errors (M, 2) as a linearization elsewhere has whitened them, pixels; NaN where there is none.

    Between one linearization and the next the whitening must stay what it is: otherwise the errors could be made
    smaller by a larger derivative, against the gradient, which takes the whitening for constant.
    """
    distortion, higher, center = split_lens(lens)
    errors = np.empty_like(observations.points1.T)
    for first, last in observations.chunks:
        rows = slice(observations.start[first], observations.start[last])
        each = _repeated(homographies[first:last], np.diff(observations.start[first : last + 1]))
        points = transfer_points(each, distortion, (observations.points1[rows] - center).T, higher)[2]
        errors[:, rows] = whiten(whitening[rows], points - (observations.points2[rows] - center).T)
    return errors.T


@dataclass(frozen=True, eq=False)
class LinearizedErrors:
    """Whitened transfer errors of some links with their derivatives, all in pixels; 0 where there is no transfer."""

    first: int  # first, last: the links ``first`` to ``last - 1``, whose correspondences are ``rows``
    last: int
    rows: slice
    errors: FloatArray  # (m, 2)
    jacobian: FloatArray  # (m, 2, 9 + K): by the entries of H and the K free parameters of the lens
    by_point1: FloatArray  # by_point1, by_point2: (m, 2, 2): by the measured points, half diagonals
    by_point2: FloatArray


@np.errstate(all="ignore")
def linearized_errors(
    observations: Observations, homographies: FloatArray, lens: FloatArray, free_lens: BoolArray
) -> Iterator[LinearizedErrors]:
    """All links, some at a time: derivatives of all correspondences at once would be most of an alignment's memory."""
    for first, last in observations.chunks:
        transferred = _transferred(observations, homographies, lens, first, last)
        derivatives = transferred.derivatives
        by_homography = derivatives.by_image[:, :, None] * derivatives.lifted
        columns = np.concatenate([by_homography.reshape(2, 9, -1), derivatives.by_lens(free_lens)], axis=1)
        yield LinearizedErrors(
            first,
            last,
            slice(int(observations.start[first]), int(observations.start[last])),
            _finite(transferred.whitened.T),
            _finite(whiten(transferred.whitening, columns).transpose(2, 0, 1)),
            _finite(transferred.whitening @ derivatives.by_point),
            _finite(-transferred.whitening),
        )


def _finite(values: FloatArray) -> FloatArray:
    """The values, and 0 where they are not finite."""
    finite: FloatArray = np.where(np.isfinite(values), values, 0.0)
    return finite


def squared_lengths(errors: FloatArray) -> FloatArray:
    """``|r|²`` (M,) of errors (M, 2); inf where there is no transfer."""
    squared: FloatArray = errors[:, 0] ** 2 + errors[:, 1] ** 2
    squared[np.isnan(squared)] = np.inf
    return squared


@dataclass(frozen=True, eq=False)
class _Transferred:
    """Correspondences of some links: whitenings (m, 2, 2), errors (2, m) in half diagonals, and whitened in pixels."""

    derivatives: TransferJacobian
    whitening: FloatArray
    error: FloatArray
    whitened: FloatArray


@np.errstate(all="ignore")
def _transferred(
    observations: Observations, homographies: FloatArray, lens: FloatArray, first: int, last: int
) -> _Transferred:
    """The correspondences of links ``first`` to ``last``, transferred."""
    rows = slice(observations.start[first], observations.start[last])
    counts = np.diff(observations.start[first : last + 1])
    scale2 = np.repeat(observations.scale2[first:last], counts)[:, None, None]
    ratio = np.repeat(observations.scale2[first:last] / observations.scale1[first:last], counts)[:, None, None]
    homography = _repeated(homographies[first:last], counts)
    distortion, higher, center = split_lens(lens)
    derivatives = transfer_jacobian(homography, distortion, observations.points1[rows] - center, higher)
    relief = None if observations.relief is None else observations.relief[rows]
    whitening = measurement_whitening(derivatives.by_point * ratio, relief) * scale2
    error = (derivatives.points - (observations.points2[rows] - center)).T
    return _Transferred(derivatives, whitening, error, whiten(whitening, error))


def _repeated(homographies: FloatArray, counts: IntArray) -> FloatArray:
    """Homographies (L, 3, 3), each for so many correspondences, (M, 3, 3), the correspondences last in memory."""
    return np.repeat(homographies.reshape(-1, 9).T, counts, axis=1).reshape(3, 3, -1).transpose(2, 0, 1)


def _link_sums(
    transferred: _Transferred, root: FloatArray, free_lens: BoolArray, edges: NDArray[np.intp]
) -> FloatArray:
    """``[J r]'[J r]`` (l, 10 + K, 10 + K) of links, whose correspondences lie between the edges (l + 1,).

    ``root`` (m,) is what a correspondence is multiplied by.
    """
    derivatives = transferred.derivatives
    columns = np.concatenate([derivatives.by_image, derivatives.by_lens(free_lens), transferred.error[:, None]], axis=1)
    columns = whiten(transferred.whitening * root[:, None, None], columns)
    products = _products(columns)
    monomials = _products(np.concatenate([derivatives.lifted, np.ones((1, len(root)))])[None])
    if len(lost := np.flatnonzero(root == 0.0)):
        products[:, lost], monomials[:, lost] = 0.0, 0.0
    sums = np.empty((len(edges) - 1, len(products), len(monomials)))
    for link, (start, stop) in enumerate(pairwise(edges.tolist())):
        np.matmul(products[:, start:stop], monomials[:, start:stop].T, out=sums[link])
    return sums[:, *_entries(columns.shape[1] - 3)]


def _products(values: FloatArray) -> FloatArray:
    """Products (P, m) of values (axes, V, m), each with itself and those after it, summed over the axes."""
    _, count, length = values.shape
    products = np.empty((count * (count + 1) // 2, length))
    start = 0
    for k in range(count):
        rows = products[start : start + count - k]
        np.multiply(values[0, k], values[0, k:], out=rows)
        for others in values[1:]:
            rows += others[k] * others[k:]
        start += count - k
    return products


@cache
def _entries(others: int) -> tuple[IntArray, IntArray]:
    """Where the products of any two columns of ``[J r]`` are, two arrays (9 + others, 9 + others).

    A column is the derivative by one of z times one coordinate of p; of the others, the lens and the error, times 1.
    """
    column, lifted = np.divmod(np.arange(9), 3)
    column, lifted = np.append(column, 3 + np.arange(others)), np.append(lifted, np.full(others, 3))
    return _number(3 + others)[np.ix_(column, column)], _number(4)[np.ix_(lifted, lifted)]


def _number(count: int) -> IntArray:
    """Which of :func:`_products` is that of two of so many values, (count, count)."""
    number = np.empty((count, count), dtype=np.intp)
    upper = np.triu_indices(count)
    number[upper] = number.T[upper] = np.arange(len(upper[0]))
    return number
