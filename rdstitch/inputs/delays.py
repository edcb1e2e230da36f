"""The clock of a sensor may be late against the camera's: its values are kept for a range of delays."""

from dataclasses import dataclass, field

import numpy as np

from rdstitch.arrays import FloatArray

DELAYS = np.linspace(-0.3, 0.3, 61)  # seconds by which a sensor's times may be later than those of the images
DELAY_STD = 0.05
"""Seconds: what is to be expected of that; buses and drivers of IMUs take milliseconds, queues tenths of a second."""


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
