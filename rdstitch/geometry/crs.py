"""Coordinate reference systems: UTM and UPS on WGS 84, and through pyproj (PROJ) every other projected one.

A zone is a number, 1 to 60 of UTM and 61 of UPS, the polar stereographic projection; negative in the south.
"""

import math
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError


class NotMetricError(ArgumentError):
    """A coordinate system that is no map in metres."""


_AXIS = 6378137.0  # m: semi-major axis of the ellipsoid
_FLATTENING = 1 / 298.257223563
_SCALE = 0.9996  # of UTM on the central meridian
_FALSE_EASTING = 500_000.0  # m, of UTM
_FALSE_NORTHING = 10_000_000.0  # m, of UTM in the south
_POLAR_SCALE = 0.994  # of UPS at the pole
_POLAR_FALSE = 2_000_000.0  # m, of UPS along both axes
_POLAR = 61  # the zone after the last one of UTM: UPS
_THIRD_FLATTENING = _FLATTENING / (2 - _FLATTENING)
_RADIUS = _SCALE * _AXIS / (1 + _THIRD_FLATTENING) * (1 + _THIRD_FLATTENING**2 / 4 + _THIRD_FLATTENING**4 / 64)
_ECCENTRICITY = math.sqrt(_FLATTENING * (2 - _FLATTENING))
_POLAR_RADIUS = (
    2
    * _POLAR_SCALE
    * _AXIS
    / math.sqrt((1 + _ECCENTRICITY) ** (1 + _ECCENTRICITY) * (1 - _ECCENTRICITY) ** (1 - _ECCENTRICITY))
)
_NORTH = 32600  # plus the zone: EPSG code of UTM on WGS 84 in the north
_SOUTH = 32700  # plus the zone: the same in the south

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
        if not (abs(phi) <= 90.0 and math.isfinite(away)):
            raise ArgumentError(f"no zone of UTM has its middle at {phi:g}, {away:g} degrees")
        return cls(epsg_of(_zone_at(phi, away) * (1 if phi >= 0 else -1)))

    @property
    def _zone(self) -> int:
        """The zone that the code stands for; 0 of other systems."""
        for first, sign in ((_NORTH, 1), (_SOUTH, -1)):
            if 1 <= self.epsg - first <= _POLAR:
                return sign * (self.epsg - first)
        return 0

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
        squared = _FLATTENING * (2 - _FLATTENING)
        radius = _AXIS * (1 - squared) / (1 - squared * math.sin(phi) ** 2) ** 1.5  # of the meridian
        ratio = float(np.hypot(*(ends[1] - ends[0]))) / (radius * math.radians(2 * step))
        return ratio if abs(ratio - 1) > _MAP_SCALE_ERROR else 1.0

    @property
    def name(self) -> str:
        """Code and name."""
        zone = self._zone
        if abs(zone) == _POLAR:
            return f"EPSG:{self.epsg}, UPS {'north' if zone > 0 else 'south'}"
        if zone:
            return f"EPSG:{self.epsg}, UTM zone {abs(zone)}{'N' if zone > 0 else 'S'}"
        return f"EPSG:{self.epsg}"

    def project(self, latitude: ArrayLike, longitude: ArrayLike) -> FloatArray:
        """Easting and northing (N, 2), m, of places (N,) on WGS 84, degrees."""
        if self._zone:
            return _utm(latitude, longitude, self._zone)
        longitude, latitude = (np.asarray(angles, dtype=np.float64) for angles in (longitude, latitude))
        return transformed(f"EPSG:{WGS84}", f"EPSG:{self.epsg}", longitude, latitude)

    def geographic(self, places: ArrayLike) -> FloatArray:
        """Latitude and longitude (N, 2) on WGS 84, degrees, of eastings and northings (N, 2), m."""
        east, north = np.asarray(places, dtype=np.float64).reshape(-1, 2).T
        if self._zone:
            with np.errstate(over="ignore", invalid="ignore"):  # of what is no place of the zone
                return _from_utm(east, north, self._zone)
        return transformed(f"EPSG:{self.epsg}", f"EPSG:{WGS84}", east, north)[:, ::-1]

    def well_known_text(self) -> str:
        """The definition, as a ``.prj`` file has it."""
        zone, south = abs(self._zone), self._zone < 0
        if zone == _POLAR:
            name, pole = ("South", -90.0) if south else ("North", 90.0)
            return (
                f'PROJCS["UPS_{name}",{_GEOGCS},PROJECTION["Stereographic"],'
                f'PARAMETER["False_Easting",{_POLAR_FALSE}],PARAMETER["False_Northing",{_POLAR_FALSE}],'
                f'PARAMETER["Central_Meridian",0.0],PARAMETER["Scale_Factor",{_POLAR_SCALE}],'
                f'PARAMETER["Latitude_Of_Origin",{pole}],UNIT["Meter",1.0]]'
            )
        if not zone:
            system = f"EPSG:{self.epsg}"
            return str(load_pyproj(system).CRS.from_user_input(system).to_wkt("WKT1_ESRI"))
        return (
            f'PROJCS["WGS_1984_UTM_Zone_{zone}{"S" if south else "N"}",{_GEOGCS},'
            f'PROJECTION["Transverse_Mercator"],PARAMETER["False_Easting",{_FALSE_EASTING}],'
            f'PARAMETER["False_Northing",{_FALSE_NORTHING if south else 0.0}],'
            f'PARAMETER["Central_Meridian",{_central_meridian(zone):.1f}],PARAMETER["Scale_Factor",{_SCALE}],'
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


def _zone_at(latitude: float, longitude: float) -> int:
    """Number of the UTM zone of a place, with those that are wider for Norway and Svalbard; 61 near the poles."""
    if not -80.0 <= latitude <= 84.0:
        return _POLAR
    if 56.0 <= latitude < 64.0 and 3.0 <= longitude < 12.0:
        return 32
    if latitude >= 72.0 and 0.0 <= longitude < 42.0:
        return 31 + 2 * int((longitude + 3.0) // 12.0)
    return int((longitude + 180.0) // 6.0) % 60 + 1


def epsg_of(zone: int) -> int:
    """EPSG code of a zone."""
    return (_NORTH if zone > 0 else _SOUTH) + abs(zone)


def _utm(latitude: ArrayLike, longitude: ArrayLike, zone: int) -> FloatArray:
    """UTM coordinates (N, 2) on WGS 84, m: easting and northing, of degrees (N,); the zone is negative in the south.

    Of UPS (zone 61) the polar stereographic projection (Snyder 1987, equations 15-9 and 21-33). Krüger's series to the
    third power of the third flattening (Karney 2011, equations 7-9, 11, 35): exact to 0.1 mm within a zone.
    """
    phi = np.radians(np.asarray(latitude, dtype=np.float64))
    degrees = np.asarray(longitude, dtype=np.float64) - _central_meridian(abs(zone))
    away = np.radians((degrees + 180.0) % 360.0 - 180.0)
    n = _THIRD_FLATTENING
    eccentricity = 2 * math.sqrt(n) / (1 + n)
    if abs(zone) == _POLAR:
        pole = math.copysign(1.0, zone)
        sine = np.sin(pole * phi)
        conformal = np.exp(eccentricity * np.arctanh(eccentricity * sine)) * np.tan(np.pi / 4 - pole * phi / 2)
        distance = _POLAR_RADIUS * conformal
        return _POLAR_FALSE + np.stack([distance * np.sin(away), -pole * distance * np.cos(away)], axis=-1)
    sine = np.sin(phi)
    t = np.sinh(np.arctanh(sine) - eccentricity * np.arctanh(eccentricity * sine))
    xi, eta = np.arctan2(t, np.cos(away)), np.arctanh(np.sin(away) / np.hypot(1.0, t))
    series = (n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16, 13 * n**2 / 48 - 3 * n**3 / 5, 61 * n**3 / 240)
    orders: list[NDArray[np.complex128]] = [xi + 1j * eta]
    for order, factor in enumerate(series, start=1):
        orders.append(np.asarray(factor * np.sin(2 * order * orders[0]), dtype=np.complex128))
    place = _RADIUS * np.sum(orders, axis=0)
    return np.stack([_FALSE_EASTING + place.imag, place.real + (_FALSE_NORTHING if zone < 0 else 0.0)], axis=-1)


def _from_utm(east: FloatArray, north: FloatArray, zone: int) -> FloatArray:
    """The inverse of :func:`_utm` (Karney 2011, equations 15, 18, 25, 36; latitude from the conformal one by series).

    Exact to 1 mm within a zone.
    """
    n = _THIRD_FLATTENING
    if abs(zone) == _POLAR:
        x, y, pole = east - _POLAR_FALSE, north - _POLAR_FALSE, math.copysign(1.0, zone)
        chi = np.pi / 2 - 2 * np.arctan(np.hypot(x, y) / _POLAR_RADIUS)
        return np.stack([pole * np.degrees(_latitude(chi)), np.degrees(np.arctan2(x, -pole * y))], axis=-1)
    place = (north - (_FALSE_NORTHING if zone < 0 else 0.0) + 1j * (east - _FALSE_EASTING)) / _RADIUS
    series = (n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96, n**2 / 48 + n**3 / 15, 17 * n**3 / 480)
    sphere = place - sum(factor * np.sin(2 * order * place) for order, factor in enumerate(series, start=1))
    conformal = np.arcsin(np.sin(sphere.real) / np.cosh(sphere.imag))
    away = np.degrees(np.arctan2(np.sinh(sphere.imag), np.cos(sphere.real))) + _central_meridian(abs(zone))
    return np.stack([np.degrees(_latitude(conformal)), (away + 180.0) % 360.0 - 180.0], axis=-1)


def _latitude(conformal: FloatArray) -> FloatArray:
    """Latitudes of conformal ones, radians."""
    n = _THIRD_FLATTENING
    series = (2 * n - 2 * n**2 / 3 - 2 * n**3, 7 * n**2 / 3 - 8 * n**3 / 5, 56 * n**3 / 15)
    return conformal + sum(factor * np.sin(2 * k * conformal) for k, factor in enumerate(series, start=1))


def _central_meridian(zone: int) -> float:
    """Degrees."""
    return 0.0 if zone == _POLAR else 6.0 * zone - 183.0
