"""The robust loss of matches under a homography and a lens, with its normal equations, for many pairs at once.

The loss is that of :mod:`rdstitch.numerics.robust_loss`, of the whitened transfer error in measured pixels.

With ``z = H p(λ)`` the derivative of the transferred point by H is ``(∂u/∂z) ⊗ p``. So a match enters ``J'J`` by a
matrix of 3 x 3 times ``p p'``, and nothing of the size of a Jacobian is ever formed.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray, Rows
from rdstitch.geometry.division_model import distorted_ratio
from rdstitch.numerics.robust_loss import loss_ratio, robust_weight
from rdstitch.robust.measurements import Measurements

_PAIRS = np.triu_indices(3)  # entries of a symmetric matrix of 3 x 3 that determine it
_ENTRY = np.zeros((3, 3), dtype=np.intp)
_ENTRY[_PAIRS] = _ENTRY.T[_PAIRS] = np.arange(6)


@dataclass(frozen=True, eq=False)
class PairLenses:
    """The lens of each of B pairs, in the half-diagonal frame; shapes (B,), and (B, 2) for the centre.

    Where only ``distortion`` is given, it is that of both images, and nothing else is to be estimated.
    """

    distortion: FloatArray
    second_distortion: FloatArray | None = None  # λ of image 2, where it is another
    distortion2: FloatArray | None = None  # μ
    center: FloatArray | None = None

    def growing(self, distortion: FloatArray, radius2: FloatArray, times: tuple[float, float]) -> FloatArray:
        """``times[0] λ + times[1] μ r²`` at squared radii (B, N), of λ (B,)."""
        first = times[0] * distortion[:, None]
        return first if self.distortion2 is None else first + times[1] * self.distortion2[:, None] * radius2


@dataclass(frozen=True, eq=False)
class TransferDerivatives(Rows):
    """Errors of transfer and their derivatives, pairs first and matches last.

    All in the undistorted image 2, where H acts without the lens: an error in measured pixels is taken there by the
    derivative of undistortion, and so is its covariance, so that whitened errors are those of measured pixels.
    """

    image: FloatArray  # (B, 2, N): transferred point ``u``, undistorted half diagonals
    inverse_depth: FloatArray  # (B, N): ``1 / z_w``, so that the derivative of ``u`` by ``z`` is ``[I | -u] / z_w``
    lifted: FloatArray  # (B, 3, N): ``p``
    # (B, E + 1, 2, N): derivative of the error by λ, or by λ of image 1, λ of image 2, μ and the distortion centre
    # where the lens has all of these; last the error itself, transferred less measured point
    columns: FloatArray
    # (B, 3, N): entries xx, xy, yy of the inverse covariance of the error, halved, for noise of a pixel in both images
    # (Sampson's weighting)
    precision: FloatArray
    squared: FloatArray  # (B, N): squared whitened errors, pixels²
    # (B, N), bool: no transfer: behind the camera, or beyond the lens model. Errors and derivatives are then finite but
    # mean nothing
    lost: BoolArray

    def whitened(self, row: IntArray, column: IntArray) -> FloatArray:
        """Whitened errors (M, 2), pixels, of some matches of some pairs; NaN where there is no transfer."""
        (xx, xy, yy), (x, y) = self.precision[row, :, column].T, self.columns[row, -1, :, column].T
        root = np.sqrt(xx)
        errors = np.column_stack([root * x + xy / root * y, np.sqrt(np.maximum(yy - xy * xy / xx, 0.0)) * y])
        errors[self.lost[row, column]] = np.nan
        return errors


@dataclass(frozen=True, eq=False)
class _Transfer:
    """Matches of B pairs transferred from image 1 to image 2, see :func:`differentiate`; (B, N) and (B, 2, N)."""

    x1: FloatArray  # x1, radius2: the points of image 1 from the distortion centre
    radius2: FloatArray
    x2: FloatArray
    lifted: FloatArray  # (B, 3, N): ``p``
    inverse_depth: FloatArray  # ``1 / z_w``
    u: FloatArray  # undistorted
    d: FloatArray  # distorted
    rho2: FloatArray  # ``|d|²``
    back: FloatArray  # ``1 / g``
    bend: FloatArray  # ``s / g``
    lost: BoolArray

    @classmethod
    def of(cls, homography: FloatArray, lens: PairLenses, data: Measurements) -> Self:
        x1, x2, radius2 = data.x1, data.x2, data.radius2
        if lens.center is not None:
            x1, x2 = x1 - lens.center[:, :, None], x2 - lens.center[:, :, None]
            radius2 = x1[:, 0] ** 2 + x1[:, 1] ** 2
        lifted = np.empty((len(x1), 3, x1.shape[2]))
        lifted[:, :2] = x1
        lifted[:, 2] = 1.0 + lens.growing(lens.distortion, radius2, (1.0, 1.0)) * radius2
        z = homography @ lifted
        lost = ~(z[:, 2] > 0.0)
        inverse_depth = 1.0 / np.where(lost, 1.0, z[:, 2])
        u = z[:, :2] * inverse_depth[:, None]
        mu, second = lens.distortion2, lens.distortion if lens.second_distortion is None else lens.second_distortion
        g = distorted_ratio(u[:, 0] ** 2 + u[:, 1] ** 2, second[:, None], None if mu is None else mu[:, None])
        lost |= np.isnan(g)
        g[lost] = 1.0
        d = u * g[:, None]
        rho2 = d[:, 0] ** 2 + d[:, 1] ** 2
        back = 1.0 / g
        bend = lens.growing(second, rho2, (2.0, 4.0)) * back
        lost |= ~(bend * rho2 < 1.0)
        return cls(x1, radius2, x2, lifted, inverse_depth, u, d, rho2, back, bend, lost)


def differentiate(homography: FloatArray, lens: PairLenses, data: Measurements) -> TransferDerivatives:
    """Transfer the matches of each pair from image 1 to image 2, with all derivatives.

    With ``u = z_xy / z_w`` and d the distorted point, ``g = 1 + λ ρ² + μ ρ⁴``, ``ρ = |d|``, ``s = 2λ + 4μρ²``,
    ``k = g - s ρ²``: the derivative of undistortion is ``A = (I - (s/g) d d') / g``; d is one to one where ``k > 0``,
    and that of u by λ at fixed d is ``-d ρ² / g²``. With M the derivative of u by the measured point of image 1, unit
    noise in both images gives the error the covariance ``A A' + M M'``.

    ``homography`` (B, 3, 3).
    """
    at = _Transfer.of(homography, lens, data)
    # Derivatives of u by the lifted coordinate of image 1, and M.
    u, depth = at.u, at.inverse_depth
    by_lifted = (homography[:, :2, 2:] - u * homography[:, 2:, 2:]) * depth[:, None]
    by_point = (homography[:, :2, :2, None] - u[:, :, None] * homography[:, 2:, :2, None]) * depth[:, None, None]
    slope = lens.growing(lens.distortion, at.radius2, (2.0, 4.0))
    by_point += by_lifted[:, :, None] * (at.x1 * slope[:, None])[:, None]
    difference = at.d - at.x2
    along = (at.d[:, 0] * difference[:, 0] + at.d[:, 1] * difference[:, 1]) * at.bend
    error = (difference - at.d * along[:, None]) * at.back[:, None]
    columns = _lens_columns(lens, at, by_lifted, by_point)
    columns[:, -1] = error
    precision = _precision(at, by_point, data)
    left = precision[:, :2] * error[:, :1] + precision[:, 1:] * error[:, 1:]
    left *= error
    squared = left[:, 0] + left[:, 1]
    return TransferDerivatives(u, depth, at.lifted, columns, precision, squared, at.lost)


def _lens_columns(lens: PairLenses, at: _Transfer, by_lifted: FloatArray, by_point: FloatArray) -> FloatArray:
    """Derivatives of the error by the lens, see :class:`TransferDerivatives`; the last column is left to be filled."""
    by_lambda2 = at.u * (at.rho2 * at.back)[:, None]
    per_image = lens.second_distortion is not None
    columns = np.empty((len(at.d), 6 if per_image else 2, 2, at.d.shape[2]))
    if not per_image:
        columns[:, 0] = by_lifted * at.radius2[:, None] + by_lambda2
        return columns
    columns[:, 0] = by_lifted * at.radius2[:, None]
    columns[:, 1] = by_lambda2
    columns[:, 2] = by_lifted * (at.radius2**2)[:, None] + by_lambda2 * at.rho2[:, None]
    columns[:, 3:5] = -(at.d * (at.bend * at.back)[:, None])[:, None] * at.d[:, :, None] - by_point.swapaxes(1, 2)
    columns[:, 3, 0] += at.back
    columns[:, 4, 1] += at.back
    return columns


def _precision(at: _Transfer, by_point: FloatArray, data: Measurements) -> FloatArray:
    """Inverse covariances (B, 3, N) of the errors, see :class:`TransferDerivatives`; ``by_point`` is M."""
    by_point = by_point * data.px_ratio[:, None, None, None]
    back2 = at.back * at.back
    turned = back2 * at.bend * (at.bend * at.rho2 - 2.0)
    spread = by_point[:, :, 0] ** 2 + by_point[:, :, 1] ** 2 + at.d * at.d * turned[:, None] + back2[:, None]
    across = by_point[:, 0] * by_point[:, 1]
    xy = across[:, 0] + across[:, 1] + at.d[:, 0] * at.d[:, 1] * turned
    xx, yy = spread[:, 0], spread[:, 1]
    scale = (2.0 * data.px**2)[:, None] / (xx * yy - xy * xy)
    precision = np.empty((len(at.d), 3, at.d.shape[2]))
    precision[:, 0], precision[:, 1], precision[:, 2] = yy * scale, xy * -scale, xx * scale
    return precision


def entry_equations(
    transferred: TransferDerivatives, present: BoolArray, scale: FloatArray, free_lens: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The loss (B,) of a scale (B,), pixels, its normal matrix and its gradient, by the entries of H, then the lens."""
    useless = transferred.lost | ~present
    relative = loss_ratio(transferred.squared, scale[:, None])
    relative[useless] = 0.0
    cost = (transferred.squared * relative).sum(axis=1) + scale**2 * (transferred.lost & present).sum(axis=1)
    columns, by_z, left = _weighted(transferred, relative * relative, free_lens)
    batch, size, _, count = columns.shape
    extra = size - 1

    lifted = transferred.lifted
    monomials = (lifted[:, _PAIRS[0]] * lifted[:, _PAIRS[1]]).swapaxes(1, 2)
    quadratic = (by_z[:, :3].reshape(batch, 9, count) @ monomials)[:, :, _ENTRY].reshape(batch, 3, 3, 3, 3)
    linear = (by_z[:, 3:].reshape(batch, 3 * size, count) @ lifted.swapaxes(1, 2)).reshape(batch, size, 9)
    information = np.empty((batch, 9 + extra, 9 + extra))
    gradient = np.empty((batch, 9 + extra))
    information[:, :9, :9] = quadratic.transpose(0, 1, 3, 2, 4).reshape(batch, 9, 9)
    gradient[:, :9] = linear[:, extra]
    if extra:
        information[:, 9:, :9] = linear[:, :extra]
        information[:, :9, 9:] = linear[:, :extra].swapaxes(1, 2)
        flat = columns.reshape(batch, size, 2 * count)
        of_lens = left.reshape(batch, size, 2 * count)[:, :extra] @ flat.swapaxes(1, 2)
        information[:, 9:, 9:] = of_lens[:, :, :extra]
        gradient[:, 9:] = of_lens[:, :, extra]
    return cost, information, gradient


def influence(transferred: TransferDerivatives, present: BoolArray, scale: FloatArray, free_lens: bool) -> FloatArray:
    """Each match's share of the gradient by the entries of H and the lens, (B, N, 9 + E)."""
    factor = robust_weight(transferred.squared, scale[:, None])
    factor[~present | transferred.lost] = 0.0
    columns, by_z, left = _weighted(transferred, factor, free_lens)
    batch, size, _, count = columns.shape
    by_h = (by_z[:, -1, :, None] * transferred.lifted[:, None]).reshape(batch, 9, count)
    by_lens = (columns[:, : size - 1] * left[:, None, -1]).sum(axis=2)
    return np.ascontiguousarray(np.concatenate([by_h, by_lens], axis=1).swapaxes(1, 2))


def _weighted(
    transferred: TransferDerivatives, factor: FloatArray, free_lens: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The columns that are free, (B, C, 2, N), and their products with the weights and the derivatives of u.

    The columns, (B, 3 + C, 3, N) of ``z`` and the columns with ``z``, and the columns times their weights.
    """
    columns = transferred.columns if free_lens else transferred.columns[:, -1:]
    weight = transferred.precision * factor[:, None]
    batch, size, _, count = columns.shape
    u, inverse_depth = transferred.image, transferred.inverse_depth[:, None]
    left = np.empty((batch, size, 2, count))
    np.multiply(weight[:, None, :2], columns[:, :, :1], out=left)
    left += weight[:, None, 1:] * columns[:, :, 1:]
    by_z = np.empty((batch, 3 + size, 3, count))
    np.multiply(left, inverse_depth[:, None], out=by_z[:, 3:, :2])
    weight *= inverse_depth**2
    by_z[:, 0, :2], by_z[:, 1, :2] = weight[:, :2], weight[:, 1:]
    by_z[:, 2, :2] = weight[:, :2] * -u[:, :1] - weight[:, 1:] * u[:, 1:]
    last = by_z[:, :, 2]
    np.multiply(by_z[:, :, 0], -u[:, :1], out=last)
    last -= by_z[:, :, 1] * u[:, 1:]
    return columns, by_z, left
