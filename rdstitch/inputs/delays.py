"""The clock of a sensor may be late against the camera's: its values are kept for a range of delays."""

from dataclasses import dataclass, field

import numpy as np

from rdstitch.arrays import FloatArray

DELAYS = np.linspace(-0.3, 0.3, 61)  # seconds by which a sensor's times may be later than those of the images
DELAY_STD = 0.05
"""Seconds: what is to be expected of that; buses and drivers of IMUs take milliseconds, queues tenths of a second."""

# Degree 5 over 0.6 s follows swaying at a few hertz, and not the noise between samples.
_POLYNOMIALS = np.linalg.qr(np.vander(DELAYS / DELAYS[-1], 6))[0]
_SLOW = _POLYNOMIALS @ _POLYNOMIALS.T


@dataclass(frozen=True)
class MeasuredTilt:
    """(ψ, θ), radians, of an image as a gimbal or an IMU has measured it."""

    tilt: tuple[float, float]
    # (S, 2): the same at :data:`DELAYS`; None where it has no times
    by_delay: FloatArray | None = field(default=None, compare=False, repr=False)

    @property
    def at_delays(self) -> FloatArray:
        """(S, 2): the same at :data:`DELAYS`, which changes nothing where it has no times."""
        return np.tile(self.tilt, (len(DELAYS), 1)) if self.by_delay is None else self.by_delay


def at_delay(values: FloatArray, delay: float) -> FloatArray:
    """Of values (..., S, D) at :data:`DELAYS` those (..., D) at one delay, between which they change evenly."""
    place = float(np.clip(np.interp(delay, DELAYS, np.arange(len(DELAYS))), 0.0, len(DELAYS) - 1.0))
    low = min(int(place), len(DELAYS) - 2)
    return np.asarray(values[..., low, :] + (place - low) * (values[..., low + 1, :] - values[..., low, :]))


def smooth(values: FloatArray) -> FloatArray:
    """The slow part of values (..., S, D) at :data:`DELAYS`: noise must not decide on the delay."""
    return np.asarray(np.einsum("st,...td->...sd", _SLOW, values))


def change_with_delay(values: FloatArray) -> FloatArray:
    """Root mean square change (..., D) a second of values (..., S, D) within the usual delays."""
    usual = np.abs(DELAYS) <= DELAY_STD
    change = np.gradient(smooth(values), DELAYS, axis=-2)[..., usual, :]
    return np.asarray(np.sqrt(np.mean(change**2, axis=-2)))
