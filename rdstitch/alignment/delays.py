"""Values of a sensor whose clock is late: at one of the delays that inputs keep them for, and without their noise."""

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.inputs.delays import DELAY_STD, DELAYS

# Degree 5 over 0.6 s follows swaying at a few hertz, and not the noise between samples.
_POLYNOMIALS = np.linalg.qr(np.vander(DELAYS / DELAYS[-1], 6))[0]
_SLOW = _POLYNOMIALS @ _POLYNOMIALS.T


def at_delay(values: FloatArray, delay: float) -> FloatArray:
    """Interpolate values (..., S, D) at :data:`DELAYS` linearly to one delay, s: (..., D)."""
    place = float(np.clip(np.interp(delay, DELAYS, np.arange(len(DELAYS))), 0.0, len(DELAYS) - 1.0))
    low = min(int(place), len(DELAYS) - 2)
    return np.asarray(values[..., low, :] + (place - low) * (values[..., low + 1, :] - values[..., low, :]))


def smooth(values: FloatArray) -> FloatArray:
    """Slow part of values (..., S, D) at :data:`DELAYS`: noise must not decide on the delay."""
    return np.asarray(np.einsum("st,...td->...sd", _SLOW, values))


def change_with_delay(values: FloatArray) -> FloatArray:
    """Root mean square change (..., D) a second of values (..., S, D) within the usual delays."""
    usual = np.abs(DELAYS) <= DELAY_STD
    change = np.gradient(smooth(values), DELAYS, axis=-2)[..., usual, :]
    return np.asarray(np.sqrt(np.mean(change**2, axis=-2)))
