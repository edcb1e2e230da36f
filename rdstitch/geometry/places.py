"""Places on the Earth, of cameras and of points that images show."""

from dataclasses import dataclass


@dataclass(frozen=True)
class GpsPosition:
    """Where the camera was: WGS 84 latitude and longitude, degrees; altitude, m above sea, or None.

    ``std``: standard deviations of one horizontal coordinate and of the altitude, m, where the receiver says them.
    """

    latitude: float
    longitude: float
    altitude: float | None = None
    std: tuple[float, float] | None = None


@dataclass(frozen=True)
class GroundControl:
    """A point whose place is known: its name, the place, and the pixel of an image that shows it.

    ``epsg`` is the code of the coordinate system that the place was given in, ``std`` the standard deviation of one of
    its coordinates, m, where known; a ``check`` point is compared with the map, and takes no part in it.
    """

    name: str
    place: GpsPosition
    epsg: int
    pixel: tuple[float, float]
    std: float | None = None
    check: bool = False
