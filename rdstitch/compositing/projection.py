"""How directions become places of a flat image: plane, cylinder, sphere, and Mercator's cylinder.

Directions have x to the right, y down, z ahead. Longitude ``atan2(x, z)`` grows to the right, and latitude
``atan2(y, |x, z|)`` downwards. All but the plane show the longitude itself, so that a full turn is 2π wide; they agree
near the horizon, where the unit is a radian.

========= ================================= ==================================================
plane     (x / z, y / z)                    straight lines stay straight; less than 180 degrees
cylinder  (longitude, tan latitude)         verticals stay straight; wide and low
sphere    (longitude, latitude)             everything, equirectangular; what viewers expect
mercator  (longitude, asinh tan latitude)   keeps shapes; between cylinder and sphere
========= ================================= ==================================================
"""

import math
from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray

TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Projection:
    """One of the projections.

    Attributes
    ----------
    name : str
        "plane", "cylinder", "sphere" or "mercator".
    """

    name: str = "plane"

    @property
    def periodic(self) -> bool:
        """Whether places a full turn apart are the same."""
        return self.name != "plane"

    @property
    def largest_latitude(self) -> float:
        """What it can show without absurd stretching, radians."""
        return {"plane": 0.45, "cylinder": 0.42, "mercator": 0.47, "sphere": 0.5}[self.name] * np.pi

    def latitude_limit(self, max_stretch: float) -> float:
        """Latitude, radians, up to which it stretches images no more than so many times, in no direction.

        The sphere has none: it stretches poles beyond all measure, and is there to show them.
        """
        if self.name == "sphere":
            return 0.5 * np.pi
        stretch = max_stretch if self.name == "mercator" else math.sqrt(max_stretch)
        return min(math.acos(1.0 / stretch), self.largest_latitude)

    def project(self, directions: FloatArray) -> FloatArray:
        """Places (..., 2) of directions (..., 3) of any length; NaN where there are none."""
        x, y, z = np.moveaxis(directions, -1, 0)
        with np.errstate(all="ignore"):
            if self.name == "plane":
                z = np.where(z > 0.0, z, np.nan)
                return np.stack([x / z, y / z], axis=-1)
            slope = y / np.hypot(x, z)
            if self.name == "sphere":
                slope = np.arctan(slope)
            elif self.name == "mercator":
                slope = np.arcsinh(slope)
        return np.stack([np.arctan2(x, z), slope], axis=-1)

    def directions(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Direction of each place, any length, by coordinate; NaN beyond the poles. x and y broadcast."""
        if self.name == "plane":
            return x, y, np.ones(())
        if self.name == "sphere":
            level = np.where(np.abs(y) <= np.pi / 2, np.cos(y), np.nan)
            return np.sin(x) * level, np.sin(y), np.cos(x) * level
        with np.errstate(over="ignore"):
            slope = y if self.name == "cylinder" else np.sinh(y)
        return np.sin(x), slope, np.cos(x)


PLANE = Projection("plane")
