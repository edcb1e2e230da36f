"""The output's place on the Earth: as GeoTIFF tags, as a world file, and in words.

The output is a plane seen straight from above, so that a similarity takes its pixels to map coordinates. See
:mod:`rdstitch.georeferencing.map_fit` for how it is fitted.
"""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Self

import numpy as np
from msgspec import Struct, field
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.geometry.crs import Crs, middle
from rdstitch.georeferencing.camera_views import as_complex
from rdstitch.io.tiff import ExtraTag

_MODEL_SCALE, _MODEL_TIEPOINT, _MODEL_TRANSFORMATION, _GEO_KEYS = 33550, 33922, 34264, 34735
_SHORT, _DOUBLE = 3, 12


class PositionKind(StrEnum):
    """What positions are of, as the sidecar and sentences have it."""

    GPS = "GPS positions"
    CONTROL = "ground control points"


class Residual(Struct, frozen=True):
    """How far east and north of a position, of an image or a point, the map has it by all others, m."""

    name: str
    # east, north: None where the map does not reach the position, or the output does not show it
    east: float | None = field(name="east_m")
    north: float | None = field(name="north_m")
    used: bool

    @classmethod
    def of(cls, name: str, error: complex, used: bool) -> Self:
        """From east + i north, which is not finite where it is not known."""
        return cls(name, error.real, error.imag, used) if cmath.isfinite(error) else cls(name, None, None, False)

    @property
    def distance(self) -> float:
        """How far that is, m; 0 where it is not known."""
        return math.hypot(self.east or 0.0, self.north or 0.0)


@dataclass(frozen=True)
class Georeference:
    """A similarity from pixels of the output to map coordinates."""

    crs: Crs
    scale: complex  # metres per pixel times the turn: easting + i northing = ``scale`` (x - i y) + ``origin``
    origin: complex  # easting + i northing of the centre of the top-left pixel, m
    # root mean square distance of the positions used from where all others and the images put them, m; None of a grid
    rms: float | None = None
    source: PositionKind = PositionKind.GPS  # what the positions are
    residuals: tuple[Residual, ...] = ()  # of every position
    # standard deviation of one coordinate of a place on the ground, in the mean over the positions, m
    std: float | None = None
    map_scale: float = 1.0  # metres of the map per metre on the ground, where that is worth telling
    assumption: str = ""  # what had to be assumed of the cameras, and how far that may shift the map
    checks: tuple[Residual, ...] = ()  # of points that took no part
    scale_std: float = 0.0  # relative, of the scale; of the direction in radians

    @property
    def used(self) -> int:
        """How many positions were used."""
        return sum(residual.used for residual in self.residuals)

    @property
    def rejected(self) -> tuple[Residual, ...]:
        """Residuals of the positions that were not used."""
        return tuple(residual for residual in self.residuals if not residual.used)

    @property
    def gsd(self) -> float:
        """Ground sample distance, m."""
        return abs(self.scale) / self.map_scale

    @property
    def clockwise_deg(self) -> float:
        """By how much the output must be turned clockwise for north to be up, degrees."""
        return -math.degrees(math.atan2(self.scale.imag, self.scale.real))

    @property
    def north_up(self) -> bool:
        """Whether north is up, to less than rounding shows."""
        return abs(self.clockwise_deg) < 1e-9

    @property
    def pixel_to_map(self) -> FloatArray:
        """Affine (2, 3) from pixels of the output to easting and northing, m."""
        a, b = self.scale.real, self.scale.imag
        return np.array([[a, b, self.origin.real], [b, -a, self.origin.imag]])

    def after(self, change: FloatArray) -> "Georeference":
        """Of pixels that a similarity (3, 3) has moved to where they are now."""
        factor = complex(change[0, 0], change[0, 1])
        scale = self.scale / factor
        if abs(scale.imag) < 1e-12 * abs(scale):
            scale = complex(scale.real)  # north, or south, is exactly up
        return replace(self, scale=scale, origin=self.origin - scale * complex(change[0, 2], -change[1, 2]))

    def in_pixels(self, other: "Georeference") -> FloatArray:
        """Similarity (3, 3) from pixels of another output on the same map to pixels of this one."""
        factor, shift = other.scale / self.scale, (other.origin - self.origin) / self.scale
        a, b = factor.real, factor.imag
        return np.array([[a, b, shift.real], [-b, a, -shift.imag], [0.0, 0.0, 1.0]])

    def in_system(self, crs: Crs, pixels: ArrayLike) -> "Georeference":
        """The same place in another coordinate system, nearest at some pixels (N, 2) of the output."""
        if crs == self.crs:
            return self
        points = np.asarray(pixels, dtype=np.float64)
        latitude, longitude = self.crs.geographic(self.to_map(points)).T
        places = crs.project(latitude, longitude) @ np.array([1, 1j])
        flipped = as_complex(points)
        system = np.stack([flipped, np.ones_like(flipped)], axis=1)
        scale, origin = np.linalg.lstsq(system, places, rcond=None)[0].tolist()
        map_scale = crs.map_scale(*middle(latitude, longitude))
        return replace(self, crs=crs, scale=scale, origin=origin, map_scale=map_scale)

    def to_map(self, points: ArrayLike) -> FloatArray:
        """Easting and northing (N, 2), m, of pixels (N, 2) of the output."""
        matrix = self.pixel_to_map
        return np.asarray(np.asarray(points, dtype=np.float64) @ matrix[:, :2].T + matrix[:, 2])

    def tiff_tags(self) -> list[ExtraTag]:
        """What makes a TIFF file a GeoTIFF."""
        a, b = self.scale.real, self.scale.imag
        # GeoTIFF counts from the corner of the first pixel.
        corner = self.origin - self.scale * (0.5 - 0.5j)
        # Version 1.1.0 and three keys: projected, pixels are areas, which system.
        keys = (1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, self.crs.epsg)
        if self.north_up:  # as more programs read it
            place = [
                (_MODEL_SCALE, _DOUBLE, 3, (a, a, 0.0), True),
                (_MODEL_TIEPOINT, _DOUBLE, 6, (0.0, 0.0, 0.0, corner.real, corner.imag, 0.0), True),
            ]
        else:
            matrix = (a, b, 0.0, corner.real, b, -a, 0.0, corner.imag, *(0.0,) * 7, 1.0)
            place = [(_MODEL_TRANSFORMATION, _DOUBLE, len(matrix), matrix, True)]
        return [*place, (_GEO_KEYS, _SHORT, len(keys), keys, True)]

    def world_file_texts(self) -> tuple[str, str]:
        """The contents of :func:`world_file_paths`."""
        numbers = self.pixel_to_map.T.ravel().tolist()
        return "".join(f"{number:.10f}\n" for number in numbers), self.crs.well_known_text() + "\n"


def world_file_paths(image: str | Path) -> tuple[Path, ...]:
    """The world file, and the coordinate system as .prj, of an image; none where its own format has a place for both.

    Deep Zoom images and OME-Zarr have none either: nothing that shows them would read it.
    """
    file = Path(image)
    kind = file.suffix.lower()
    if kind in (".tif", ".tiff", ".dzi", ".zarr"):
        return ()
    return file.with_suffix(f"{kind[:2]}{kind[-1]}w"), file.with_suffix(".prj")


def map_summary(place: Georeference) -> str:
    """What there is to say of a georeference, in one line."""
    side = "left" if place.clockwise_deg > 0 else "right"
    turned = "" if place.north_up else f", north {abs(place.clockwise_deg):.1f}° {side} of up"
    text = f"georeferenced: {place.crs.name}, {place.gsd:.4g} m a pixel{turned}"
    if place.rms is not None:
        agreeing = "GPS agree with the map" if place.source is PositionKind.GPS else f"{place.source} agree"
        count = f"{place.used} of {len(place.residuals)}"
        text += f"; {agreeing} to {metres(place.rms)} ({count}, each predicted by the others)"
    if place.source is PositionKind.CONTROL and place.used:
        text += f", worst {_worst(place, place.residuals)}"
    return text if place.std is None else f"{text}; map ± {metres(place.std)}"


def check_summary(place: Georeference) -> str:
    """How far check points are off, in one line."""
    seen = [check for check in place.checks if check.used]
    if not seen:
        return f"none of {len(place.checks)} check points is in the output"
    rms = math.sqrt(sum(check.distance**2 for check in seen) / len(seen))
    worst = _worst(place, seen)
    return f"{len(seen)} check points: {metres(rms)} off horizontally (rms), worst {worst}"


def _worst(place: Georeference, residuals: Sequence[Residual]) -> str:
    worst = max((one for one in residuals if one.used), key=lambda one: one.distance)
    return f"{worst.name} by {metres(worst.distance)} = {worst.distance / abs(place.scale):.1f} pixels"


def metres(value: float) -> str:
    """A length with its unit, to two digits, but no finer than a millimetre."""
    digits = max(0, min(3, 1 - math.floor(math.log10(value)))) if value > 0.0 and math.isfinite(value) else 1
    return f"{value:.{digits}f} m"
