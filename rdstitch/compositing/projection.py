"""How directions become places of a flat image. A projection is one class here, and one word of the command line.

Directions have x to the right, y down, z ahead. Longitude ``atan2(x, z)`` grows to the right, and latitude
``atan2(y, |x, z|)`` downwards. All agree straight ahead, where the unit is a radian.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.choices import ProjectionName

TURN = 2.0 * np.pi
_MAX_STRETCH = 16.0  # of any projection, whatever is requested

Directions = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class Projection(ABC):
    """What all projections have."""

    name: ClassVar[ProjectionName]  # as the command line has it
    # whether its first coordinate is the longitude, so that places a full turn apart are the same
    periodic: ClassVar[bool] = False

    @abstractmethod
    def project(self, directions: FloatArray) -> FloatArray:
        """Places (..., 2) of directions (..., 3) of any length; NaN or infinite where there are none."""

    @abstractmethod
    def directions(self, x: FloatArray, y: FloatArray) -> Directions:
        """Direction of each place, any length, by coordinate; NaN where there is none. x and y broadcast."""

    @abstractmethod
    def extent(self, max_stretch: float) -> tuple[float, float]:
        """Largest x and y, to both sides, up to which it stretches what lies on that axis no more than so many times.

        No more than a fixed multiple, however large ``max_stretch`` is.
        """


class Plane(Projection):
    """``(x / z, y / z)``: straight lines stay straight; less than 180 degrees."""

    name = "plane"

    def project(self, directions: FloatArray) -> FloatArray:
        """Places in front; NaN behind."""
        ahead = directions[..., 2:]
        with np.errstate(all="ignore"):
            places: FloatArray = directions[..., :2] / np.where(ahead > 0.0, ahead, np.nan)
        return places

    def directions(self, x: FloatArray, y: FloatArray) -> Directions:
        return x, y, np.ones(())

    def extent(self, max_stretch: float) -> tuple[float, float]:
        """The limit in x and y, of lengths away from the middle."""
        reach = math.sqrt(min(max_stretch, _MAX_STRETCH) - 1.0)
        return reach, reach


class _Longitude(Projection):
    """The longitude, and a function of the latitude's tangent."""

    periodic = True

    @abstractmethod
    def _height(self, slope: FloatArray) -> FloatArray:
        """The y of a latitude, by its tangent."""

    @abstractmethod
    def _slope(self, height: FloatArray) -> FloatArray:
        """The tangent of the latitude of a y; NaN where there is none."""

    @abstractmethod
    def _highest(self, stretch: float) -> float:
        """The y up to which lengths are stretched no more than so many times."""

    def project(self, directions: FloatArray) -> FloatArray:
        """Places of all directions; infinite at poles, where that is so."""
        x, y, z = np.moveaxis(directions, -1, 0)
        with np.errstate(all="ignore"):
            return np.stack([np.arctan2(x, z), self._height(y / np.hypot(x, z))], axis=-1)

    def directions(self, x: FloatArray, y: FloatArray) -> Directions:
        with np.errstate(over="ignore"):
            return np.sin(x), self._slope(y), np.cos(x)

    def extent(self, max_stretch: float) -> tuple[float, float]:
        """The limit in latitude; all longitudes."""
        return math.inf, self._highest(min(max_stretch, _MAX_STRETCH))


class Cylinder(_Longitude):
    """``(longitude, tan latitude)``: verticals stay straight; wide and low."""

    name = "cylinder"

    def _height(self, slope: FloatArray) -> FloatArray:
        return slope

    def _slope(self, height: FloatArray) -> FloatArray:
        return height

    def _highest(self, stretch: float) -> float:
        return math.sqrt(stretch - 1.0)  # heights grow with 1 / cos²


class Mercator(_Longitude):
    """``(longitude, asinh tan latitude)``: keeps shapes; between cylinder and sphere."""

    name = "mercator"

    def _height(self, slope: FloatArray) -> FloatArray:
        return np.arcsinh(slope)

    def _slope(self, height: FloatArray) -> FloatArray:
        return np.sinh(height)

    def _highest(self, stretch: float) -> float:
        return math.acosh(stretch)  # lengths grow with 1 / cos


class Sphere(_Longitude):
    """``(longitude, latitude)``, equirectangular: everything; what viewers expect.

    It stretches poles beyond all measure, and is there to show them.
    """

    name = "sphere"

    def _height(self, slope: FloatArray) -> FloatArray:
        return np.arctan(slope)

    def _slope(self, height: FloatArray) -> FloatArray:
        return np.where(np.abs(height) <= np.pi / 2, np.tan(height), np.nan)

    def _highest(self, stretch: float) -> float:
        return math.pi / 2.0


class Panini(Projection):
    """A cylinder seen from its far side: verticals, and lines towards the middle, stay straight; up to 150 degrees.

    ``(2 tan(longitude / 2), 2 tan latitude / (1 + cos longitude))`` (Sharpless, Postle and German 2010).
    """

    name = "panini"

    def project(self, directions: FloatArray) -> FloatArray:
        """Places of all but what is straight behind."""
        with np.errstate(all="ignore"):
            level = np.hypot(directions[..., :1], directions[..., 2:])
            places: FloatArray = 2.0 * directions[..., :2] / (level + directions[..., 2:])
        return places

    def directions(self, x: FloatArray, y: FloatArray) -> Directions:
        return x, y, 1.0 - x**2 / 4.0

    def extent(self, max_stretch: float) -> tuple[float, float]:
        """Both grow with 1 / cos², of half the longitude and of the latitude."""
        reach = math.sqrt(min(max_stretch, _MAX_STRETCH) - 1.0)
        return 2.0 * reach, reach


class Stereographic(Projection):
    """``2 (x, y) / (1 + z)``: keeps shapes, shows all but what is straight behind; looking down, a small planet."""

    name = "stereographic"

    def project(self, directions: FloatArray) -> FloatArray:
        """Places of all but what is straight behind."""
        with np.errstate(all="ignore"):
            length = np.linalg.norm(directions, axis=-1, keepdims=True)
            places: FloatArray = 2.0 * directions[..., :2] / (length + directions[..., 2:])
        return places

    def directions(self, x: FloatArray, y: FloatArray) -> Directions:
        return x, y, 1.0 - (x**2 + y**2) / 4.0

    def extent(self, max_stretch: float) -> tuple[float, float]:
        """Lengths grow with 1 / cos² of half the angle."""
        reach = 2.0 * math.sqrt(min(max_stretch, _MAX_STRETCH) - 1.0)
        return reach, reach


PLANE = Plane()
PROJECTIONS: dict[ProjectionName, Projection] = {
    projection.name: projection for projection in (PLANE, Cylinder(), Sphere(), Mercator(), Panini(), Stereographic())
}
