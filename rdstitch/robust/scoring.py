"""How well hypotheses explain the matches: truncated transfer error in measured pixels."""

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.radial_homography import are_homographies
from rdstitch.robust.measurements import Measurements
from rdstitch.solvers.solutions import Solutions

_BLOCK = 1 << 15  # hypotheses x matches at once: the temporaries stay in cache


def plausible(solutions: Solutions, corner_radius: float) -> BoolArray:
    """Which solutions could be two images of a plane, shape (M,).

    Impossible are a lens that folds within the image (``1 + λ r² <= 0`` at a corner, or ``λ r² >= 1``, where the
    undistorted radius stops growing), a mirrored image (``det H < 0``), and an image squeezed to a line.
    """
    return are_homographies(solutions.homography) & (np.abs(solutions.distortion * corner_radius**2) < 1.0)


def transfer_errors2(homography: FloatArray, distortion: FloatArray, pair: IntArray, data: Measurements) -> FloatArray:
    """Squared transfer errors of every hypothesis on the matches of its pair, px², (M, N); inf where undefined.

    Written out for speed: with ``z = H p(λ)`` the distorted point is
    ``2 z_xy / (z_w + sqrt(z_w² - 4 λ |z_xy|²))``.

    ``homography`` (M, 3, 3); ``distortion`` (M,); ``pair`` (M,): the pair that each belongs to; ``data``: of B pairs.
    """
    basis = np.empty((len(data), 4, data.present.shape[1]))
    basis[:, :2], basis[:, 2], basis[:, 3] = data.x1, 1.0, data.radius2
    coefficients = np.concatenate([homography, homography[:, :, 2:] * distortion[:, None, None]], axis=2)
    errors = np.empty((len(homography), data.present.shape[1]))
    step = max(1, _BLOCK // errors.shape[1])
    for start in range(0, len(errors), step):
        part = slice(start, start + step)
        pairs = pair[part]
        z = np.matmul(coefficients[part], basis[pairs])
        squares = z[:, 0] ** 2
        squares += z[:, 1] ** 2
        squares *= -4.0 * distortion[part, None]
        w = z[:, 2]
        squares += w * w
        undefined = (w <= 0.0) | (squares < 0.0)
        denominator = np.sqrt(np.abs(squares, out=squares), out=squares)
        denominator += w
        denominator[undefined] = 1.0
        factor = np.divide(2.0, denominator, out=denominator)
        difference = z[:, :2]
        difference *= factor[:, None]
        difference -= data.x2[pairs]
        difference *= difference
        squared = np.add(difference[:, 0], difference[:, 1], out=errors[part])
        squared *= (data.px[pairs] ** 2)[:, None]
        squared[undefined] = np.inf
    return errors


def truncated_costs(
    homography: FloatArray, distortion: FloatArray, pair: IntArray, data: Measurements, threshold: float
) -> FloatArray:
    """Mean of ``min(error², threshold²) / threshold²`` over the matches of the pair, per hypothesis, shape (M,)."""
    errors2 = transfer_errors2(homography, distortion, pair, data)
    np.minimum(errors2, threshold**2, out=errors2)
    if not data.present.all():
        errors2 *= data.present[pair]
    total: FloatArray = errors2.sum(axis=1)
    return total / (threshold**2 * np.maximum(data.count[pair], 1))
