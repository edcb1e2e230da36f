"""Coordinate reference systems: UTM on WGS 84, and through rasterio every other projected one."""

import math
import re
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError

_AXIS, _FLATTENING, _SCALE = 6378137.0, 1 / 298.257223563, 0.9996
_FALSE_EASTING, _FALSE_NORTHING = 500_000.0, 10_000_000.0
WGS84 = 4326
"""Code of latitude and longitude on WGS 84."""

_THIRD_FLATTENING = _FLATTENING / (2 - _FLATTENING)
_RADIUS = _SCALE * _AXIS / (1 + _THIRD_FLATTENING) * (1 + _THIRD_FLATTENING**2 / 4 + _THIRD_FLATTENING**4 / 64)
_NORTH, _SOUTH = 32600, 32700  # EPSG codes of UTM on WGS 84 are these and the zone


@dataclass(frozen=True)
class Crs:
    """A projected coordinate reference system in metres."""

    epsg: int

    def __post_init__(self) -> None:
        if self._zone == 0:
            _check_projected(self.epsg)

    @classmethod
    def utm(cls, latitude: float, longitude: float) -> "Crs":
        """UTM on WGS 84 in the zone of a place, degrees."""
        zone = int(np.clip((longitude + 180) // 6 + 1, 1, 60))
        return cls((_NORTH if latitude >= 0 else _SOUTH) + zone)

    @property
    def _zone(self) -> int:
        """Of UTM on WGS 84, negative in the south; 0 of other systems."""
        for first, sign in ((_NORTH, 1), (_SOUTH, -1)):
            if 1 <= self.epsg - first <= 60:
                return sign * (self.epsg - first)
        return 0

    @property
    def name(self) -> str:
        """Code and name."""
        zone = self._zone
        if zone:
            return f"EPSG:{self.epsg}, UTM zone {abs(zone)}{'N' if zone > 0 else 'S'}"
        return f"EPSG:{self.epsg}"

    def project(self, latitude: ArrayLike, longitude: ArrayLike) -> FloatArray:
        """Easting and northing (N, 2), m, of places (N,) on WGS 84, degrees."""
        if self._zone:
            return utm(latitude, longitude, self._zone)
        rasterio = _rasterio(self.epsg)
        east, north = rasterio.warp.transform(
            rasterio.crs.CRS.from_epsg(WGS84),
            rasterio.crs.CRS.from_epsg(self.epsg),
            np.asarray(longitude, dtype=np.float64),
            np.asarray(latitude, dtype=np.float64),
        )
        return np.stack([east, north], axis=-1)

    def geographic(self, places: ArrayLike) -> FloatArray:
        """Latitude and longitude (N, 2) on WGS 84, degrees, of eastings and northings (N, 2), m."""
        east, north = np.asarray(places, dtype=np.float64).reshape(-1, 2).T
        if self._zone:
            with np.errstate(over="ignore", invalid="ignore"):  # of what is no place of the zone
                return _from_utm(east, north, self._zone)
        rasterio = _rasterio(self.epsg)
        systems = (rasterio.crs.CRS.from_epsg(code) for code in (self.epsg, WGS84))
        longitude, latitude = rasterio.warp.transform(*systems, east, north)
        return np.stack([latitude, longitude], axis=-1)

    def well_known_text(self) -> str:
        """The definition, as a ``.prj`` file has it."""
        zone, south = abs(self._zone), self._zone < 0
        if not zone:
            return str(_rasterio(self.epsg).crs.CRS.from_epsg(self.epsg).to_wkt(version="WKT1_ESRI"))
        return (
            f'PROJCS["WGS_1984_UTM_Zone_{zone}{"S" if south else "N"}",GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",'
            'SPHEROID["WGS_1984",6378137.0,298.257223563]],PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]],'
            f'PROJECTION["Transverse_Mercator"],PARAMETER["False_Easting",{_FALSE_EASTING}],'
            f'PARAMETER["False_Northing",{_FALSE_NORTHING if south else 0.0}],'
            f'PARAMETER["Central_Meridian",{_central_meridian(zone):.1f}],PARAMETER["Scale_Factor",{_SCALE}],'
            'PARAMETER["Latitude_Of_Origin",0.0],UNIT["Meter",1.0]]'
        )


def epsg_of(text: str) -> int | None:
    """Code of the coordinate system that a line of OpenDroneMap's lists names; None where it names none.

    ``EPSG:32632``, ``WGS84 UTM 32N`` and PROJ's ``+proj=utm +zone=32 +datum=WGS84`` and ``+proj=longlat`` are known.
    """
    if code := re.fullmatch(r"EPSG:(\d{1,5})", text.strip(), re.IGNORECASE):
        return int(code[1])
    if code := re.fullmatch(r"WGS ?84 UTM (\d{1,2}) ?([NS])", text.strip(), re.IGNORECASE):
        return (_NORTH if code[2] in "nN" else _SOUTH) + int(code[1])
    if re.search(r"\+proj=(longlat|latlong)\b", text):
        return WGS84
    if re.search(r"\+proj=utm\b", text) and (code := re.search(r"\+zone=(\d{1,2})\b", text)):
        return (_SOUTH if "+south" in text else _NORTH) + int(code[1])
    return None


def utm(latitude: ArrayLike, longitude: ArrayLike, zone: int) -> FloatArray:
    """UTM coordinates (N, 2) on WGS 84, m: easting and northing, of degrees (N,); the zone is negative in the south.

    Krüger's series to the third power of the third flattening (Karney 2011, equations 7-9, 11, 35): exact to 0.1 mm
    within a zone.
    """
    phi = np.radians(np.asarray(latitude, dtype=np.float64))
    away = np.radians(np.asarray(longitude, dtype=np.float64) - _central_meridian(abs(zone)))
    n = _THIRD_FLATTENING
    eccentricity = 2 * math.sqrt(n) / (1 + n)
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
    """The inverse of :func:`utm` (Karney 2011, equations 15, 18, 25 and 36; latitude from the conformal one by series).

    Exact to 1 mm within a zone.
    """
    n = _THIRD_FLATTENING
    place = (north - (_FALSE_NORTHING if zone < 0 else 0.0) + 1j * (east - _FALSE_EASTING)) / _RADIUS
    series = (n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96, n**2 / 48 + n**3 / 15, 17 * n**3 / 480)
    sphere = place - sum(factor * np.sin(2 * order * place) for order, factor in enumerate(series, start=1))
    conformal = np.arcsin(np.sin(sphere.real) / np.cosh(sphere.imag))
    to_latitude = (2 * n - 2 * n**2 / 3 - 2 * n**3, 7 * n**2 / 3 - 8 * n**3 / 5, 56 * n**3 / 15)
    phi = conformal + sum(factor * np.sin(2 * k * conformal) for k, factor in enumerate(to_latitude, start=1))
    away = np.arctan2(np.sinh(sphere.imag), np.cos(sphere.real))
    return np.stack([np.degrees(phi), np.degrees(away) + _central_meridian(abs(zone))], axis=-1)


def _central_meridian(zone: int) -> float:
    """Degrees."""
    return 6.0 * zone - 183.0


def _rasterio(epsg: int) -> ModuleType:
    """The module, with what is needed of it."""
    try:
        module = import_module("rasterio")
        import_module("rasterio.warp")
    except ImportError as error:
        raise ArgumentError(
            f"EPSG:{epsg} needs rasterio (pip install 'rdstitch[crs]'); UTM on WGS 84, EPSG:32601 to 32660 and "
            "32701 to 32760, does not"
        ) from error
    return module


def _check_projected(epsg: int) -> None:
    """Refuse what is not a projected system in metres."""
    rasterio = _rasterio(epsg)
    try:
        with rasterio.Env():  # else GDAL prints
            crs = rasterio.crs.CRS.from_epsg(epsg)
    except rasterio.errors.CRSError as error:
        raise ArgumentError(f"EPSG:{epsg} is not known; give the code of a projected coordinate system") from error
    if not crs.is_projected or crs.linear_units != "metre":
        raise ArgumentError(f"EPSG:{epsg} is not a projected coordinate system in metres; choose one that is")
