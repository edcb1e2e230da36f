"""How well many hypotheses explain the correspondences: truncated transfer error in measured pixels."""

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.robust.measurements import Measurements
from rdstitch.solvers.solutions import Solutions

_BLOCK = 1 << 16  # hypotheses x points at once: the temporaries stay in cache

_LEAST_DETERMINANT = 1e-6


def plausible(solutions: Solutions, corner_radius: float) -> NDArray[np.bool_]:
    """Which solutions could be two pictures of a plane, shape (M,).

    Impossible are a lens that folds within the picture (``1 + λ r² <= 0`` at a corner, or ``λ r² >= 1``, where the
    undistorted radius stops growing), a mirrored picture (``det H < 0``), and a picture squeezed to a line.
    """
    h = solutions.homography
    with np.errstate(invalid="ignore", over="ignore"):
        size = np.linalg.norm(h, axis=(1, 2))
        determinant = np.linalg.det(h) / size**3
        bend = solutions.distortion * corner_radius**2
        return np.asarray(np.isfinite(size) & (determinant > _LEAST_DETERMINANT) & (np.abs(bend) < 1.0))


def transfer_errors2(homography: FloatArray, distortion: FloatArray, data: Measurements) -> FloatArray:
    """Squared transfer errors of every hypothesis on every correspondence, px², shape (M, N); inf where undefined.

    Written out for speed: with ``z = H p(λ)`` the distorted point is
    ``2 z_xy / (z_w + sqrt(z_w² - 4 λ |z_xy|²))``.
    """
    basis = np.stack([data.x1[:, 0], data.x1[:, 1], np.ones(len(data)), np.einsum("ni,ni->n", data.x1, data.x1)])
    coefficients = np.concatenate([homography, homography[:, :, 2:] * distortion[:, None, None]], axis=2)
    z = np.matmul(coefficients, basis)
    squares = z[:, 0] ** 2
    squares += z[:, 1] ** 2
    squares *= -4.0 * distortion[:, None]
    w = z[:, 2]
    squares += w * w
    undefined = (w <= 0.0) | (squares < 0.0)
    denominator = np.sqrt(np.abs(squares, out=squares), out=squares)
    denominator += w
    denominator[undefined] = 1.0
    factor = np.divide(2.0, denominator, out=denominator)
    dx = z[:, 0] * factor - data.x2[:, 0]
    dy = z[:, 1] * factor - data.x2[:, 1]
    errors = dx * dx
    errors += dy * dy
    errors *= data.px**2
    errors[undefined] = np.inf
    return np.asarray(errors)


def truncated_costs(solutions: Solutions, data: Measurements, threshold: float) -> FloatArray:
    """Mean of ``min(error², threshold²) / threshold²`` over the correspondences, per hypothesis, shape (M,)."""
    costs = np.empty(len(solutions))
    step = max(1, _BLOCK // max(1, len(data)))
    for start in range(0, len(solutions), step):
        part = slice(start, start + step)
        errors = transfer_errors2(solutions.homography[part], solutions.distortion[part], data)
        costs[part] = np.minimum(errors, threshold**2, out=errors).mean(axis=1)
    return costs / threshold**2
