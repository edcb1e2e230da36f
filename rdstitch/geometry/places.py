"""Places on the Earth, of cameras and of points that images show."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

POSITION_STD = 3.0
"""Metres: of one coordinate of a position by a receiver without corrections, within one flight."""

MILLIMETRE = 1e-3  # metres to which coordinates are written: no place is more exact


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


def contradicting_places(
    names: Sequence[str], places: Sequence[tuple[float, float]], stds: Sequence[float | None]
) -> tuple[int, int, float] | None:
    """Two of some points (x, y), metres, of one name that are further apart than they are exact, and how far."""
    of_name: dict[str, list[int]] = {}
    for k, name in enumerate(names):
        former = of_name.setdefault(name, [])
        for one in former:
            distance = math.dist(places[one], places[k])
            if distance > max(stds[one] or MILLIMETRE, stds[k] or MILLIMETRE):
                return one, k, distance
        former.append(k)
    return None
