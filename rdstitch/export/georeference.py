"""Where the output lies on the Earth, by the images' positions or ground control points: GeoTIFF tags, or a world file.

The output is a plane seen straight from above, so that a similarity takes its pixels to map coordinates. It is fitted
robustly to ground control points, or to the positions of the cameras, which are taken to be above the centres of their
images.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.alignment.position_priors import POSITION_STD
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.crs import WGS84, Crs
from rdstitch.geometry.radial_homography import to_plane
from rdstitch.io.metadata import GpsPosition, GroundControl
from rdstitch.io.tiff import ExtraTag
from rdstitch.robust.similarity_fit import fit_similarity

MIN_POSITIONS = 3
# Positions must agree with the images to this share of their own spread: else it is no view from above, or the GPS
# says less than nothing.
_MAX_ERROR = 0.25
_CONTROL_STD = 0.03  # m: of a point surveyed by satellite with corrections
_GPS, _CONTROL = "GPS positions", "ground control points"
_MODEL_SCALE, _MODEL_TIEPOINT, _MODEL_TRANSFORMATION, _GEO_KEYS = 33550, 33922, 34264, 34735
_SHORT, _DOUBLE = 3, 12


@dataclass(frozen=True)
class Residual:
    """How far east and north of a position, of an image or a control point, the output has it, m."""

    name: str
    east: float
    north: float
    used: bool

    @property
    def off(self) -> float:
        """The distance, m."""
        return math.hypot(self.east, self.north)


@dataclass(frozen=True)
class Georeference:
    """A similarity from pixels of the output to map coordinates."""

    crs: Crs
    scale: complex  # metres per pixel times the turn: easting + i northing = ``scale`` (x - i y) + ``origin``
    origin: complex  # easting + i northing of the centre of the top-left pixel, m
    rms: float  # root mean square distance of the positions used from where the images put them, m
    source: str = _GPS  # what the positions are
    residuals: tuple[Residual, ...] = ()  # of every position

    @property
    def used(self) -> int:
        """How many positions were used."""
        return sum(residual.used for residual in self.residuals)

    @property
    def rejected(self) -> tuple[tuple[str, float], ...]:
        """Names of images, or control points, whose positions were not used, and how far these are off, m."""
        return tuple((residual.name, residual.off) for residual in self.residuals if not residual.used)

    @property
    def gsd(self) -> float:
        """Ground sample distance, m."""
        return abs(self.scale)

    @property
    def clockwise_deg(self) -> float:
        """By how much the output must be turned clockwise for north to be up, degrees."""
        return -math.degrees(math.atan2(self.scale.imag, self.scale.real))

    @property
    def north_up(self) -> bool:
        """Whether north is up, to less than rounding shows."""
        return abs(self.clockwise_deg) < 1e-9

    @property
    def summary(self) -> str:
        """Everything that there is to say of it, in one line."""
        turned = "" if self.north_up else f", north {abs(self.clockwise_deg):.1f}° {self._side} of up"
        return (
            f"georeferenced: {self.crs.name}, {self.gsd:.4g} m a pixel{turned}; {self.used} of {len(self.residuals)} "
            f"{self.source} used, {self.rms:.2f} m rms"
        )

    @property
    def _side(self) -> str:
        return "left" if self.clockwise_deg > 0 else "right"

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
            scale = complex(abs(scale))
        return replace(self, scale=scale, origin=self.origin - scale * complex(change[0, 2], -change[1, 2]))

    def to_map(self, points: ArrayLike) -> FloatArray:
        """Easting and northing (N, 2), m, of pixels (N, 2) of the output."""
        matrix = self.pixel_to_map
        places: FloatArray = np.asarray(points, dtype=np.float64) @ matrix[:, :2].T + matrix[:, 2]
        return places

    def tiff_tags(self) -> list[ExtraTag]:
        """Give what makes a TIFF file a GeoTIFF."""
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

    A Deep Zoom image has none either: nothing that shows it would read them.
    """
    file = Path(image)
    kind = file.suffix.lower()
    if kind in (".tif", ".tiff", ".dzi"):
        return ()
    return file.with_suffix(f"{kind[:2]}{kind[-1]}w"), file.with_suffix(".prj")


def has_place(positions: Sequence[GpsPosition | None]) -> bool:
    """Check whether enough images have a position for a place to be expected."""
    return sum(position is not None for position in positions) >= MIN_POSITIONS


def georeference(
    positions: Sequence[GpsPosition | None],
    cameras: Sequence[Camera],
    to_output: FloatArray,
    names: Sequence[str],
    epsg: int | None = None,
    control: Sequence[Sequence[GroundControl]] = (),
) -> tuple[Georeference | None, str]:
    """Place the output on the Earth, or say why that cannot be done; control points, where there are any, count alone.

    ``to_output`` (N, 3, 3) takes normalized undistorted coordinates of each image to pixels of the output. Without
    ``epsg`` the map is that of the control points, else UTM on WGS 84.
    """
    source, std = (_CONTROL, _CONTROL_STD) if any(control) else (_GPS, POSITION_STD)
    if source == _GPS:
        control = [
            () if place is None else (GroundControl(name, place, WGS84, _middle(camera)),)
            for name, place, camera in zip(names, positions, cameras, strict=True)
        ]
    # A control point that several images show counts once, at the mean of where they have it.
    shown: dict[str | int, list[tuple[GroundControl, complex]]] = {}
    for k, points in enumerate(control):
        for point in points:
            x, y = to_plane(cameras[k], to_output[k], np.array([point.pixel])).reshape(2)
            shown.setdefault(k if source == _GPS else point.name, []).append((point, complex(x, -y)))
    known = [same[0][0] for same in shown.values()]
    if len(known) < MIN_POSITIONS:
        what = f"of {len(names)} images have a GPS position" if source == _GPS else f"{source} are in the images"
        return None, f"{len(known)} {what}, and {MIN_POSITIONS} are needed"
    latitude, longitude = np.array([(point.place.latitude, point.place.longitude) for point in known]).T
    if epsg is None and known[0].epsg != WGS84:
        epsg = known[0].epsg
    crs = Crs.utm(float(np.median(latitude)), float(np.median(longitude))) if epsg is None else Crs(epsg)
    places = crs.project(latitude, longitude) @ np.array([1, 1j])
    pixels = np.array([np.mean([pixel for _, pixel in same]) for same in shown.values()])
    usable = np.isfinite(places) & np.isfinite(pixels)
    if usable.sum() < MIN_POSITIONS:
        return None, f"{crs.name} does not reach the {source}"
    fit = fit_similarity(pixels[usable], places[usable], std)
    used = np.zeros(len(known), dtype=bool)
    used[usable] = fit.inliers
    off = np.full(len(known), complex(np.inf))
    off[usable] = fit.scale * pixels[usable] + fit.origin - places[usable]
    rms = math.sqrt(float(np.mean(np.abs(off[used]) ** 2)))
    spread = math.sqrt(float(np.mean(np.abs(places[used] - places[used].mean()) ** 2)))
    # Four of the coordinates are used up by the fit: three positions agree with anything to some extent.
    free = max(1.0 - 2.0 / max(int(used.sum()), 1), 1e-9)
    if used.sum() < max(MIN_POSITIONS, len(known) / 2) or not rms < _MAX_ERROR * spread * math.sqrt(free):
        median = float(np.median(np.abs(off)))
        return None, f"the {source} are {median:.1f} m off in the median, and spread over {spread:.1f} m"
    residuals = tuple(Residual(p.name, e.real, e.imag, u) for p, e, u in zip(known, off, used.tolist(), strict=True))
    return Georeference(crs, fit.scale, fit.origin, rms, source, residuals), ""


def _middle(camera: Camera) -> tuple[float, float]:
    """The centre of an image, pixels."""
    width, height = camera.image_size
    return (width - 1) / 2, (height - 1) / 2
