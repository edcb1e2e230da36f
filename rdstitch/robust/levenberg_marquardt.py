"""Levenberg-Marquardt: how damping follows its steps, and the steps of many small problems in lockstep."""

from contextlib import suppress

import numpy as np

from rdstitch.arrays import FloatArray

MIN_DAMPING = 1e-9  # fraction of the diagonal of the normal matrix
MAX_DAMPING = 1e4  # from where on a descent has got stuck


def damping_by_gain(damping: float, failures: int, gain: float) -> tuple[float, int]:
    """Damping of the next step, and how many steps have failed since one was taken (Nielsen 1999).

    Where the loss has a curved valley, as focal length, tilts and lens together have, tenfold changes go to and fro
    between steps that are too short and steps that fail.

    ``gain``: by how much the last step made the loss smaller, in units of what was predicted.
    """
    if gain > 0.0:
        return max(damping * max(1.0 / 3.0, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3), MIN_DAMPING), 0
    return damping * 2.0 ** (failures + 1), failures + 1


def damped_step(information: FloatArray, gradient: FloatArray, damping: FloatArray) -> FloatArray:
    """Steps (B, P) of B problems; NaN where the equations are singular or not finite."""
    diagonal = np.einsum("bpp->bp", information)
    largest = diagonal.max(axis=1, keepdims=True)
    solvable = np.isfinite(information).all(axis=(1, 2)) & (largest[:, 0] > 0.0)
    damped = information.copy()
    np.einsum("bpp->bp", damped)[...] += damping[:, None] * diagonal + 1e-12 * largest
    damped[~solvable] = np.eye(damped.shape[1])
    try:
        step = -np.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:  # one of them is singular nevertheless
        step = np.full(gradient.shape, np.nan)
        for row in range(len(step)):
            with suppress(np.linalg.LinAlgError):
                step[row] = -np.linalg.solve(damped[row], gradient[row])
    step[~solvable] = np.nan
    return np.asarray(step, dtype=np.float64)
