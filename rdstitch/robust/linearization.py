"""The robust loss of matches under a homography and a lens, with its normal equations, for many pairs at once.

The loss is that of :mod:`rdstitch.robust.loss`, of the whitened transfer error in measured pixels.

With ``z = H p(λ)`` the derivative of the transferred point by H is ``(∂d/∂z) ⊗ p``. So a match enters ``J'J`` by a
matrix of 3 x 3 times ``p p'``, and nothing of the size of a Jacobian is ever formed.
"""

from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.division_model import distorted_ratio
from rdstitch.robust.levenberg_marquardt import BatchedNormalEquations
from rdstitch.robust.loss import loss_ratio, robust_weight
from rdstitch.robust.measurements import Measurements

_PAIRS = np.triu_indices(3)  # entries of a symmetric matrix of 3 x 3 that determine it
_ENTRY = np.zeros((3, 3), dtype=np.intp)
_ENTRY[_PAIRS] = _ENTRY.T[_PAIRS] = np.arange(6)


@dataclass(frozen=True)
class PairLenses:
    """The lens of each of B pairs, in the half-diagonal frame; shapes (B,), and (B, 2) for the centre.

    Where only ``distortion`` is given, it is that of both images, and nothing else is to be estimated.
    """

    distortion: FloatArray
    own_distortion: FloatArray | None = None  # λ of image 2, where it is another
    distortion2: FloatArray | None = None  # μ
    center: FloatArray | None = None


@dataclass(frozen=True)
class TransferDerivatives:
    """Errors of transfer and their derivatives; pixels of image 2, pairs first and matches last."""

    error: FloatArray  # (B, 2, N): transferred less measured point
    # (B, 2, 3, N): by ``z = H p``, so that the derivative by ``H[i, j]`` is ``by_image[:, :, i] * lifted[:, j]``
    by_image: FloatArray
    lifted: FloatArray  # (B, 3, N): ``p``
    # (B, 2, E, N): by λ; or by λ of image 1, λ of image 2, μ and the distortion centre where the lens has all of these
    by_lens: FloatArray
    # (B, 3, N): entries xx, xy, yy of the inverse covariance of the error for unit noise in both images, halved: ``((I
    # + J J') / 2)⁻¹``, J the derivative by the point of image 1 (Sampson's weighting)
    precision: FloatArray
    # (B, N), bool: no transfer: behind the camera, or beyond the lens model. Errors and derivatives are then finite but
    # mean nothing
    lost: BoolArray

    @property
    def squared(self) -> FloatArray:
        """Squared whitened errors, (B, N)."""
        dx, dy = self.error[:, 0], self.error[:, 1]
        xx, xy, yy = self.precision[:, 0], self.precision[:, 1], self.precision[:, 2]
        return dx * (xx * dx + 2.0 * xy * dy) + yy * dy * dy


def differentiate(homography: FloatArray, lens: PairLenses, data: Measurements) -> TransferDerivatives:
    """Transfer the matches of each pair from image 1 to image 2, with all derivatives.

    With ``u = z_xy / z_w`` and d the distorted point, ``g = 1 + λ ρ² + μ ρ⁴``, ``ρ = |d|``, ``k = g - (2λ + 4μρ²) ρ²``:
    ``dd/du = g (I + (2λ + 4μρ²) d d' / k)``, and at fixed u ``dd/dλ = d ρ² / k``.

    Parameters
    ----------
    homography : ndarray of shape (B, 3, 3)
    lens : PairLenses
    data : Measurements
    """
    first = lens.distortion[:, None]
    second = first if lens.own_distortion is None else lens.own_distortion[:, None]
    mu = None if lens.distortion2 is None else lens.distortion2[:, None]
    x1, x2, r2 = data.x1, data.x2, data.radius2
    if lens.center is not None:
        x1, x2 = x1 - lens.center[:, :, None], x2 - lens.center[:, :, None]
        r2 = x1[:, 0] ** 2 + x1[:, 1] ** 2
    lifted = np.empty((len(x1), 3, x1.shape[2]))
    lifted[:, :2] = x1
    lifted[:, 2] = 1.0 + (first if mu is None else first + mu * r2) * r2
    z = homography @ lifted
    lost = ~(z[:, 2] > 0.0)
    w = np.where(lost, 1.0, z[:, 2])
    d = z[:, :2] / w[:, None]
    ratio = distorted_ratio(d[:, 0] ** 2 + d[:, 1] ** 2, second, mu)
    lost |= np.isnan(ratio)
    d *= np.where(lost, 0.0, ratio)[:, None]

    rho2 = d[:, 0] ** 2 + d[:, 1] ** 2
    g = 1.0 + (second if mu is None else second + mu * rho2) * rho2
    slope = 2.0 * second if mu is None else 2.0 * second + 4.0 * mu * rho2
    k = g - slope * rho2
    lost |= ~(k > 0.0)
    k[lost] = 1.0
    px = data.px[:, None]
    by_image = np.empty((*d.shape[:2], 3, d.shape[2]))
    scale = g * px / w
    np.multiply((d * (scale * slope / k)[:, None])[:, :, None], d[:, None], out=by_image[:, :, :2])
    by_image[:, 0, 0] += scale
    by_image[:, 1, 1] += scale
    np.multiply(d, (-scale / k)[:, None], out=by_image[:, :, 2])

    by_lifted = np.swapaxes(homography, 1, 2)[:, None] @ by_image
    along_third = by_lifted[:, :, 2]
    slope1 = 2.0 * first if mu is None else 2.0 * first + 4.0 * mu * r2
    by_point = by_lifted[:, :, :2] + along_third[:, :, None] * (x1 * slope1[:, None])[:, None]
    in_image2 = d * (rho2 * px / k)[:, None]
    if lens.own_distortion is None:
        by_lens = (along_third * r2[:, None] + in_image2)[:, :, None]
    else:
        by_lens = np.empty((*d.shape[:2], 5, d.shape[2]))
        by_lens[:, :, 0] = along_third * r2[:, None]
        by_lens[:, :, 1] = in_image2
        by_lens[:, :, 2] = along_third * (r2**2)[:, None] + in_image2 * rho2[:, None]
        by_lens[:, :, 3:] = -by_point
        by_lens[:, 0, 3] += px
        by_lens[:, 1, 4] += px
    precision = _precision(by_point * (data.px_ratio / data.px)[:, None, None, None])
    return TransferDerivatives((d - x2) * px[:, None], by_image, lifted, by_lens, precision, lost)


def _precision(by_point: FloatArray) -> FloatArray:
    """``((I + J J') / 2)⁻¹`` of J (B, 2, 2, N), as entries xx, xy, yy (B, 3, N)."""
    a, b = by_point[:, 0], by_point[:, 1]
    xx = 1.0 + (a[:, 0] ** 2 + a[:, 1] ** 2)
    yy = 1.0 + (b[:, 0] ** 2 + b[:, 1] ** 2)
    xy = a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]
    scale = 2.0 / (xx * yy - xy * xy)
    return np.stack([yy * scale, -xy * scale, xx * scale], axis=1)


def entry_equations(
    transferred: TransferDerivatives, present: BoolArray, scale: FloatArray, free_lens: bool
) -> BatchedNormalEquations:
    """The loss with its scale ``c`` (B,), pixels, and its normal equations by the entries of H, then by the lens."""
    squared = transferred.squared
    relative, factor = (loss(squared, scale[:, None]) for loss in (loss_ratio, robust_weight))
    lost, useless = transferred.lost & present, transferred.lost | ~present
    relative[useless] = factor[useless] = 0.0
    cost = (squared * relative).sum(axis=1) + scale**2 * lost.sum(axis=1)
    squared[useless] = np.inf

    lens = transferred.by_lens if free_lens else transferred.by_lens[:, :, :0]
    extra = lens.shape[2]
    columns = np.concatenate([transferred.by_image, lens, transferred.error[:, :, None]], axis=2)
    weight = transferred.precision * factor[:, None]
    xx, xy, yy = weight[:, :1], weight[:, 1:2], weight[:, 2:]
    across, down = columns[:, 0], columns[:, 1]
    left_across, left_down = xx * across + xy * down, xy * across + yy * down
    by_h = across[:, :3, None] * left_across[:, None] + down[:, :3, None] * left_down[:, None]

    lifted = np.swapaxes(transferred.lifted, 1, 2)
    monomials = (transferred.lifted[:, _PAIRS[0]] * transferred.lifted[:, _PAIRS[1]]).swapaxes(1, 2)
    batch, count = relative.shape
    quadratic = (by_h[:, :, :3].reshape(batch, 9, count) @ monomials)[:, :, _ENTRY]
    linear = by_h[:, :, 3:].reshape(batch, 3 * (extra + 1), count) @ lifted
    linear = linear.reshape(batch, 3, extra + 1, 3)

    information = np.empty((batch, 9 + extra, 9 + extra))
    gradient = np.empty((batch, 9 + extra))
    information[:, :9, :9] = quadratic.reshape(batch, 3, 3, 3, 3).transpose(0, 1, 3, 2, 4).reshape(batch, 9, 9)
    gradient[:, :9] = linear[:, :, extra].reshape(batch, 9)
    if extra:
        mixed = linear[:, :, :extra].transpose(0, 1, 3, 2).reshape(batch, 9, extra)
        information[:, :9, 9:] = mixed
        information[:, 9:, :9] = mixed.swapaxes(1, 2)
        of_lens = across[:, 3:-1] @ left_across[:, 3:].swapaxes(1, 2) + down[:, 3:-1] @ left_down[:, 3:].swapaxes(1, 2)
        information[:, 9:, 9:] = of_lens[:, :, :extra]
        gradient[:, 9:] = of_lens[:, :, extra]
    return BatchedNormalEquations(cost, information, gradient, squared)


def influence(transferred: TransferDerivatives, present: BoolArray, scale: FloatArray, free_lens: bool) -> FloatArray:
    """Each match's share of the gradient by the entries of H and the lens, (B, N, 9 + E)."""
    factor = robust_weight(transferred.squared, scale[:, None])
    factor[~present | transferred.lost] = 0.0
    weight = transferred.precision * factor[:, None]
    xx, xy, yy = weight[:, 0], weight[:, 1], weight[:, 2]
    dx, dy = transferred.error[:, 0], transferred.error[:, 1]
    left = np.stack([xx * dx + xy * dy, xy * dx + yy * dy], axis=1)[:, :, None]
    by_image, by_lens = ((part * left).sum(axis=1) for part in (transferred.by_image, transferred.by_lens))
    batch, _, count = by_image.shape
    by_h = (by_image[:, :, None] * transferred.lifted[:, None]).reshape(batch, 9, count)
    parts = [by_h, by_lens] if free_lens else [by_h]
    return np.ascontiguousarray(np.concatenate(parts, axis=1).swapaxes(1, 2))
