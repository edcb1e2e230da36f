"""Where the output lies on the Earth, by the positions in the pictures' EXIF: GeoTIFF tags, or a world file.

The output is a plane seen straight from above, so that a similarity takes its pixels to UTM coordinates. It is fitted
to the positions of the cameras, which are taken to be above the centres of their pictures.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.io.metadata import GpsPosition
from rdstitch.io.tiff import ExtraTag
from rdstitch.radial_homography import to_plane

_MIN_POSITIONS = 3
# Positions must agree with the picture to this share of their own spread: else it is no view from above, or the GPS
# says less than nothing.
_MAX_ERROR = 0.25
_AXIS, _FLATTENING, _SCALE = 6378137.0, 1 / 298.257223563, 0.9996
_FALSE_EASTING, _FALSE_NORTHING = 500_000.0, 10_000_000.0
_MODEL_TRANSFORMATION, _GEO_KEYS = 34264, 34735
_SHORT, _DOUBLE = 3, 12


@dataclass(frozen=True)
class Georeference:
    """A similarity from pixels of the output to UTM on WGS 84.

    Attributes
    ----------
    zone : int
        1 to 60; negative in the south.
    scale : complex
        Metres per pixel times the turn: easting + i northing = ``scale`` (x - i y) + ``origin``.
    origin : complex
        Easting + i northing of the centre of the top-left pixel, m.
    error : float
        Root mean square distance of the cameras' positions from where the picture puts them, m.
    """

    zone: int
    scale: complex
    origin: complex
    error: float

    @property
    def epsg(self) -> int:
        """Code of the coordinate system."""
        return (32600 if self.zone > 0 else 32700) + abs(self.zone)

    def to_utm(self, points: ArrayLike) -> FloatArray:
        """Easting and northing (N, 2), m, of pixels (N, 2) of the output."""
        x, y = np.asarray(points, dtype=np.float64).T
        place = self.scale * (x - 1j * y) + self.origin
        return np.stack([place.real, place.imag], axis=-1)

    def tiff_tags(self) -> list[ExtraTag]:
        """What makes a TIFF file a GeoTIFF."""
        a, b = self.scale.real, self.scale.imag
        # GeoTIFF counts from the corner of the first pixel.
        corner = self.origin - self.scale * (0.5 - 0.5j)
        matrix = (a, b, 0.0, corner.real, b, -a, 0.0, corner.imag, *(0.0,) * 7, 1.0)
        # Version 1.1.0 and three keys: projected, pixels are areas, which system.
        keys = (1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, self.epsg)
        return [(_MODEL_TRANSFORMATION, _DOUBLE, len(matrix), matrix, True), (_GEO_KEYS, _SHORT, len(keys), keys, True)]

    def world_file_texts(self) -> tuple[str, str]:
        """The contents of :func:`world_file_paths`."""
        a, b = self.scale.real, self.scale.imag
        numbers = (a, b, b, -a, self.origin.real, self.origin.imag)
        return "".join(f"{number:.10f}\n" for number in numbers), self._well_known_text() + "\n"

    def _well_known_text(self) -> str:
        zone, south = abs(self.zone), self.zone < 0
        return (
            f'PROJCS["WGS_1984_UTM_Zone_{zone}{"S" if south else "N"}",GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",'
            'SPHEROID["WGS_1984",6378137.0,298.257223563]],PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]],'
            f'PROJECTION["Transverse_Mercator"],PARAMETER["False_Easting",{_FALSE_EASTING}],'
            f'PARAMETER["False_Northing",{_FALSE_NORTHING if south else 0.0}],'
            f'PARAMETER["Central_Meridian",{_central_meridian(zone):.1f}],PARAMETER["Scale_Factor",{_SCALE}],'
            'PARAMETER["Latitude_Of_Origin",0.0],UNIT["Meter",1.0]]'
        )


def world_file_paths(picture: str | Path) -> tuple[Path, ...]:
    """The world file, and the coordinate system as .prj, of a picture; none where its own format has a place for both.

    A Deep Zoom picture has none either: nothing that shows it would read them.
    """
    file = Path(picture)
    kind = file.suffix.lower()
    if kind in (".tif", ".tiff", ".dzi"):
        return ()
    return file.with_suffix(f"{kind[:2]}{kind[-1]}w"), file.with_suffix(".prj")


def has_place(positions: Sequence[GpsPosition | None]) -> bool:
    """Whether enough pictures have a position for a place to be expected."""
    return sum(position is not None for position in positions) >= _MIN_POSITIONS


def georeference(
    positions: Sequence[GpsPosition | None], cameras: Sequence[Camera], to_output: FloatArray
) -> tuple[Georeference | None, str]:
    """Place the output on the Earth, or say why that cannot be done.

    Parameters
    ----------
    positions : sequence of GpsPosition or None
        Of each picture.
    to_output : ndarray of shape (N, 3, 3)
        Normalized undistorted coordinates of each picture to pixels of the output.

    Returns
    -------
    Georeference or None, str
        The reason is empty where too few pictures have a position: nobody expects a place then.
    """
    if not has_place(positions):
        return None, ""
    known = [k for k, position in enumerate(positions) if position is not None]
    degrees = np.array([(p.latitude, p.longitude) for p in positions if p is not None])
    latitude, longitude = np.median(degrees, axis=0)
    number = int(np.clip((longitude + 180) // 6 + 1, 1, 60))
    zone = number if latitude >= 0 else -number
    places = utm(degrees[:, 0], degrees[:, 1], zone) @ np.array([1, 1j])
    middles = np.stack([_middle(cameras[k], to_output[k]) for k in known]) @ np.array([1, -1j])
    there, here = places - places.mean(), middles - middles.mean()
    spread = math.sqrt(float(np.mean(np.abs(there) ** 2)))
    scale = complex(np.vdot(here, there) / max(float(np.vdot(here, here).real), 1e-12))
    error = math.sqrt(float(np.mean(np.abs(there - scale * here) ** 2)))
    if not error < _MAX_ERROR * spread:
        return None, f"not georeferenced: the GPS positions are {error:.1f} m off, and spread over {spread:.1f} m only"
    return Georeference(zone, scale, complex(places.mean() - scale * middles.mean()), error), ""


def utm(latitude: ArrayLike, longitude: ArrayLike, zone: int) -> FloatArray:
    """UTM coordinates (N, 2) on WGS 84, m: easting and northing.

    Krüger's series to the third power of the third flattening (Karney 2011, equations 7-9, 11, 35): exact to 0.1 mm
    within a zone.

    Parameters
    ----------
    latitude, longitude : array_like of shape (N,)
        Degrees.
    zone : int
        1 to 60; negative in the south.
    """
    phi = np.radians(np.asarray(latitude, dtype=np.float64))
    away = np.radians(np.asarray(longitude, dtype=np.float64) - _central_meridian(abs(zone)))
    n = _FLATTENING / (2 - _FLATTENING)
    radius = _SCALE * _AXIS / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    eccentricity = 2 * math.sqrt(n) / (1 + n)
    sine = np.sin(phi)
    t = np.sinh(np.arctanh(sine) - eccentricity * np.arctanh(eccentricity * sine))
    xi, eta = np.arctan2(t, np.cos(away)), np.arctanh(np.sin(away) / np.hypot(1.0, t))
    series = (n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16, 13 * n**2 / 48 - 3 * n**3 / 5, 61 * n**3 / 240)
    orders: list[NDArray[np.complex128]] = [xi + 1j * eta]
    for order, factor in enumerate(series, start=1):
        orders.append(np.asarray(factor * np.sin(2 * order * orders[0]), dtype=np.complex128))
    place = radius * np.sum(orders, axis=0)
    return np.stack([_FALSE_EASTING + place.imag, place.real + (_FALSE_NORTHING if zone < 0 else 0.0)], axis=-1)


def _central_meridian(zone: int) -> float:
    """Degrees."""
    return 6.0 * zone - 183.0


def _middle(camera: Camera, to_output: FloatArray) -> FloatArray:
    """Where the centre of a picture lies in the output, pixels."""
    width, height = camera.image_size
    return to_plane(camera, to_output, np.array([[(width - 1) / 2, (height - 1) / 2]])).reshape(2)
