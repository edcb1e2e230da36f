"""Coordinate reference systems: UTM and UPS on WGS 84, and through pyproj (PROJ) every other projected one."""

import math
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.utm import (
    AXIS,
    FALSE_EASTING,
    FALSE_NORTHING,
    FLATTENING,
    POLAR,
    POLAR_FALSE,
    POLAR_SCALE,
    SCALE,
    central_meridian,
    epsg_of,
    from_utm,
    utm,
    zone_at,
    zone_of_epsg,
)


class NotMetricError(ArgumentError):
    """A coordinate system that is no map in metres."""


WGS84 = 4326
"""Code of latitude and longitude on WGS 84."""

_MAP_SCALE_ERROR = 0.01  # UTM, UPS and national grids stay below; the Mercator projection of web maps does not

_GEOGCS = (
    'GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",SPHEROID["WGS_1984",6378137.0,298.257223563]],PRIMEM["Greenwich",0.0],'
    'UNIT["Degree",0.0174532925199433]]'
)


def middle(latitude: ArrayLike, longitude: ArrayLike) -> tuple[float, float]:
    """Median latitude and mean direction of longitude of places (N,), degrees."""
    turns = np.exp(1j * np.radians(np.asarray(longitude, dtype=np.float64)))
    return float(np.median(np.asarray(latitude))), math.degrees(np.angle(turns.sum()))


@dataclass(frozen=True)
class Crs:
    """A projected coordinate reference system in metres."""

    epsg: int

    def __post_init__(self) -> None:
        if self._zone == 0:
            _check_projected(self.epsg)

    @classmethod
    def nearest(cls, latitude: ArrayLike, longitude: ArrayLike) -> "Crs":
        """UTM on WGS 84 in the zone of the middle of places (N,), degrees; UPS near the poles."""
        phi, away = middle(latitude, longitude)
        return cls(epsg_of(zone_at(phi, away) * (1 if phi >= 0 else -1)))

    @property
    def _zone(self) -> int:
        return zone_of_epsg(self.epsg)

    @classmethod
    def in_metres(cls, epsg: int) -> "Crs | None":
        """The system of a code; None where it is not projected, or not in metres."""
        try:
            return cls(epsg)
        except NotMetricError:
            return None

    def map_scale(self, latitude: float, longitude: float) -> float:
        """Metres of the map per metre on the ground at a place, degrees; 1 where maps for surveys differ by less."""
        step = 1e-3  # degrees
        ends = self.project([latitude - step, latitude + step], [longitude, longitude])
        phi = math.radians(latitude)
        squared = FLATTENING * (2 - FLATTENING)
        radius = AXIS * (1 - squared) / (1 - squared * math.sin(phi) ** 2) ** 1.5  # of the meridian
        ratio = float(np.hypot(*(ends[1] - ends[0]))) / (radius * math.radians(2 * step))
        return ratio if abs(ratio - 1) > _MAP_SCALE_ERROR else 1.0

    @property
    def name(self) -> str:
        """Code and name."""
        zone = self._zone
        if abs(zone) == POLAR:
            return f"EPSG:{self.epsg}, UPS {'north' if zone > 0 else 'south'}"
        if zone:
            return f"EPSG:{self.epsg}, UTM zone {abs(zone)}{'N' if zone > 0 else 'S'}"
        return f"EPSG:{self.epsg}"

    def project(self, latitude: ArrayLike, longitude: ArrayLike) -> FloatArray:
        """Easting and northing (N, 2), m, of places (N,) on WGS 84, degrees."""
        if self._zone:
            return utm(latitude, longitude, self._zone)
        longitude, latitude = (np.asarray(angles, dtype=np.float64) for angles in (longitude, latitude))
        return transformed(f"EPSG:{WGS84}", f"EPSG:{self.epsg}", longitude, latitude)

    def geographic(self, places: ArrayLike) -> FloatArray:
        """Latitude and longitude (N, 2) on WGS 84, degrees, of eastings and northings (N, 2), m."""
        east, north = np.asarray(places, dtype=np.float64).reshape(-1, 2).T
        if self._zone:
            with np.errstate(over="ignore", invalid="ignore"):  # of what is no place of the zone
                return from_utm(east, north, self._zone)
        return transformed(f"EPSG:{self.epsg}", f"EPSG:{WGS84}", east, north)[:, ::-1]

    def well_known_text(self) -> str:
        """The definition, as a ``.prj`` file has it."""
        zone, south = abs(self._zone), self._zone < 0
        if zone == POLAR:
            name, pole = ("South", -90.0) if south else ("North", 90.0)
            return (
                f'PROJCS["UPS_{name}",{_GEOGCS},PROJECTION["Stereographic"],'
                f'PARAMETER["False_Easting",{POLAR_FALSE}],PARAMETER["False_Northing",{POLAR_FALSE}],'
                f'PARAMETER["Central_Meridian",0.0],PARAMETER["Scale_Factor",{POLAR_SCALE}],'
                f'PARAMETER["Latitude_Of_Origin",{pole}],UNIT["Meter",1.0]]'
            )
        if not zone:
            system = f"EPSG:{self.epsg}"
            return str(load_pyproj(system).CRS.from_user_input(system).to_wkt("WKT1_ESRI"))
        return (
            f'PROJCS["WGS_1984_UTM_Zone_{zone}{"S" if south else "N"}",{_GEOGCS},'
            f'PROJECTION["Transverse_Mercator"],PARAMETER["False_Easting",{FALSE_EASTING}],'
            f'PARAMETER["False_Northing",{FALSE_NORTHING if south else 0.0}],'
            f'PARAMETER["Central_Meridian",{central_meridian(zone):.1f}],PARAMETER["Scale_Factor",{SCALE}],'
            'PARAMETER["Latitude_Of_Origin",0.0],UNIT["Meter",1.0]]'
        )


def load_pyproj(system: str) -> ModuleType:
    """The module, which is needed for a system."""
    try:
        return import_module("pyproj")
    except ImportError as error:
        raise ArgumentError(
            f"{system} needs pyproj (pip install pyproj); UTM on WGS 84, EPSG:32601 to 32660 and 32701 to 32760, "
            "does not"
        ) from error


def transformed(source: str, target: str, x: FloatArray, y: FloatArray) -> FloatArray:
    """Coordinates (N, 2) in one system of those (N,) in another, x or longitude first; inf where there are none."""
    transformer = load_pyproj(source if target == f"EPSG:{WGS84}" else target).Transformer.from_crs(
        source, target, always_xy=True
    )
    return np.stack(transformer.transform(x, y), axis=-1)


def _check_projected(epsg: int) -> None:
    """Refuse what is not a projected system in metres."""
    pyproj = load_pyproj(f"EPSG:{epsg}")
    try:
        crs = pyproj.CRS.from_epsg(epsg)
    except pyproj.exceptions.CRSError as error:
        raise ArgumentError(f"EPSG:{epsg} is not known; give the code of a projected coordinate system") from error
    if not crs.is_projected or {axis.unit_name for axis in crs.axis_info} != {"metre"}:
        raise NotMetricError(f"EPSG:{epsg} is not a projected coordinate system in metres; choose one that is")
