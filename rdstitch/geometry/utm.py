"""UTM and UPS on WGS 84: zones, their EPSG codes, and the projections.

A zone is a number, 1 to 60 of UTM and 61 of UPS, the polar stereographic projection; negative in the south.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.arrays import FloatArray

AXIS, FLATTENING = 6378137.0, 1 / 298.257223563
"""Of the ellipsoid: the semi-major axis, m."""

SCALE, FALSE_EASTING, FALSE_NORTHING = 0.9996, 500_000.0, 10_000_000.0
"""Of UTM, m; the northing in the south only."""

POLAR_SCALE, POLAR_FALSE = 0.994, 2_000_000.0
"""Of UPS; m, along both axes."""

POLAR = 61
"""The zone after the last one is UPS."""

_THIRD_FLATTENING = FLATTENING / (2 - FLATTENING)
_RADIUS = SCALE * AXIS / (1 + _THIRD_FLATTENING) * (1 + _THIRD_FLATTENING**2 / 4 + _THIRD_FLATTENING**4 / 64)
_ECCENTRICITY = math.sqrt(FLATTENING * (2 - FLATTENING))
_POLAR_RADIUS = (
    2
    * POLAR_SCALE
    * AXIS
    / math.sqrt((1 + _ECCENTRICITY) ** (1 + _ECCENTRICITY) * (1 - _ECCENTRICITY) ** (1 - _ECCENTRICITY))
)
_NORTH, _SOUTH = 32600, 32700  # EPSG codes of UTM on WGS 84 are these and the zone


def zone_at(latitude: float, longitude: float) -> int:
    """Number of the UTM zone of a place, with those that are wider for Norway and Svalbard; 61 near the poles."""
    if not -80.0 <= latitude <= 84.0:
        return POLAR
    if 56.0 <= latitude < 64.0 and 3.0 <= longitude < 12.0:
        return 32
    if latitude >= 72.0 and 0.0 <= longitude < 42.0:
        return 31 + 2 * int((longitude + 3.0) // 12.0)
    return int((longitude + 180.0) // 6.0) % 60 + 1


def epsg_of(zone: int) -> int:
    """EPSG code of a zone."""
    return (_NORTH if zone > 0 else _SOUTH) + abs(zone)


def zone_of_epsg(epsg: int) -> int:
    """The zone that a code stands for; 0 of other systems."""
    for first, sign in ((_NORTH, 1), (_SOUTH, -1)):
        if 1 <= epsg - first <= POLAR:
            return sign * (epsg - first)
    return 0


def utm(latitude: ArrayLike, longitude: ArrayLike, zone: int) -> FloatArray:
    """UTM coordinates (N, 2) on WGS 84, m: easting and northing, of degrees (N,); the zone is negative in the south.

    Of UPS (zone 61) the polar stereographic projection (Snyder 1987, equations 15-9 and 21-33). Krüger's series to the
    third power of the third flattening (Karney 2011, equations 7-9, 11, 35): exact to 0.1 mm within a zone.
    """
    phi = np.radians(np.asarray(latitude, dtype=np.float64))
    degrees = np.asarray(longitude, dtype=np.float64) - central_meridian(abs(zone))
    away = np.radians((degrees + 180.0) % 360.0 - 180.0)
    n = _THIRD_FLATTENING
    eccentricity = 2 * math.sqrt(n) / (1 + n)
    if abs(zone) == POLAR:
        pole = math.copysign(1.0, zone)
        sine = np.sin(pole * phi)
        conformal = np.exp(eccentricity * np.arctanh(eccentricity * sine)) * np.tan(np.pi / 4 - pole * phi / 2)
        distance = _POLAR_RADIUS * conformal
        return POLAR_FALSE + np.stack([distance * np.sin(away), -pole * distance * np.cos(away)], axis=-1)
    sine = np.sin(phi)
    t = np.sinh(np.arctanh(sine) - eccentricity * np.arctanh(eccentricity * sine))
    xi, eta = np.arctan2(t, np.cos(away)), np.arctanh(np.sin(away) / np.hypot(1.0, t))
    series = (n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16, 13 * n**2 / 48 - 3 * n**3 / 5, 61 * n**3 / 240)
    orders: list[NDArray[np.complex128]] = [xi + 1j * eta]
    for order, factor in enumerate(series, start=1):
        orders.append(np.asarray(factor * np.sin(2 * order * orders[0]), dtype=np.complex128))
    place = _RADIUS * np.sum(orders, axis=0)
    return np.stack([FALSE_EASTING + place.imag, place.real + (FALSE_NORTHING if zone < 0 else 0.0)], axis=-1)


def from_utm(east: FloatArray, north: FloatArray, zone: int) -> FloatArray:
    """The inverse of :func:`utm` (Karney 2011, equations 15, 18, 25 and 36; latitude from the conformal one by series).

    Exact to 1 mm within a zone.
    """
    n = _THIRD_FLATTENING
    if abs(zone) == POLAR:
        x, y, pole = east - POLAR_FALSE, north - POLAR_FALSE, math.copysign(1.0, zone)
        chi = np.pi / 2 - 2 * np.arctan(np.hypot(x, y) / _POLAR_RADIUS)
        return np.stack([pole * np.degrees(_latitude(chi)), np.degrees(np.arctan2(x, -pole * y))], axis=-1)
    place = (north - (FALSE_NORTHING if zone < 0 else 0.0) + 1j * (east - FALSE_EASTING)) / _RADIUS
    series = (n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96, n**2 / 48 + n**3 / 15, 17 * n**3 / 480)
    sphere = place - sum(factor * np.sin(2 * order * place) for order, factor in enumerate(series, start=1))
    conformal = np.arcsin(np.sin(sphere.real) / np.cosh(sphere.imag))
    away = np.degrees(np.arctan2(np.sinh(sphere.imag), np.cos(sphere.real))) + central_meridian(abs(zone))
    return np.stack([np.degrees(_latitude(conformal)), (away + 180.0) % 360.0 - 180.0], axis=-1)


def _latitude(conformal: FloatArray) -> FloatArray:
    """Latitudes of conformal ones, radians."""
    n = _THIRD_FLATTENING
    series = (2 * n - 2 * n**2 / 3 - 2 * n**3, 7 * n**2 / 3 - 8 * n**3 / 5, 56 * n**3 / 15)
    phi: FloatArray = conformal + sum(factor * np.sin(2 * k * conformal) for k, factor in enumerate(series, start=1))
    return phi


def central_meridian(zone: int) -> float:
    """Degrees."""
    return 0.0 if zone == POLAR else 6.0 * zone - 183.0
