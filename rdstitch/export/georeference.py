"""Where the output lies on the Earth, by the images' positions or ground control points: GeoTIFF tags, or a world file.

The output is a plane seen straight from above, so that a similarity takes its pixels to map coordinates. See
:mod:`rdstitch.export.map_fit` for how it is fitted.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.export.map_fit import MapFit, Measured, Views, fit_map, views_of
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.crs import WGS84, Crs, middle
from rdstitch.geometry.places import GpsPosition, GroundControl
from rdstitch.geometry.radial_homography import to_plane
from rdstitch.io.tiff import ExtraTag

MIN_POSITIONS = 3
# Positions must agree with the images to this share of their own spread: else it is no view from above, or the GPS
# says less than nothing.
_MAX_ERROR = 0.25
PositionKind = Literal["GPS positions", "ground control points"]
GPS: PositionKind = "GPS positions"
CONTROL: PositionKind = "ground control points"
MODEL_SCALE, MODEL_TIEPOINT, MODEL_TRANSFORMATION, GEO_KEYS = 33550, 33922, 34264, 34735
_SHORT, _DOUBLE = 3, 12


@dataclass(frozen=True)
class Residual:
    """How far east and north of a position, of an image or a point, the map has it by all others, m."""

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
    # root mean square distance of the positions used from where all others and the images put them, m
    rms: float
    source: PositionKind = GPS  # what the positions are
    residuals: tuple[Residual, ...] = ()  # of every position
    # standard deviation of one coordinate of a place on the ground, in the mean over the positions, m
    std: float | None = None
    map_scale: float = 1.0  # metres of the map per metre on the ground, where that is worth telling
    assumption: str = ""  # what had to be assumed of the cameras, and how far that may shift the map
    checks: tuple[Residual, ...] = ()  # of points that took no part

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
    def summary(self) -> str:
        """Everything that there is to say of it, in one line."""
        turned = "" if self.north_up else f", north {abs(self.clockwise_deg):.1f}° {self._side} of up"
        what, agree = ("GPS", "agree with the map") if self.source == GPS else (self.source, "agree")
        text = (
            f"georeferenced: {self.crs.name}, {self.gsd:.4g} m a pixel{turned}; {what} {agree} to "
            f"{_metres(self.rms)} ({self.used} of {len(self.residuals)}, each predicted by the others)"
        )
        if self.source == CONTROL:
            text += f", worst {self._worst(self.residuals)}"
        return text if self.std is None else f"{text}; map ± {_metres(self.std)}"

    @property
    def check_summary(self) -> str:
        """How far check points are off, in one line."""
        rms = math.sqrt(sum(check.off**2 for check in self.checks) / max(len(self.checks), 1))
        return (
            f"{len(self.checks)} check points: {_metres(rms)} off horizontally (rms), worst {self._worst(self.checks)}"
        )

    def _worst(self, residuals: Sequence[Residual]) -> str:
        worst = max((one for one in residuals if one.used), key=lambda one: one.off)
        return f"{worst.name} by {_metres(worst.off)} = {worst.off / abs(self.scale):.1f} pixels"

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
        flipped = points @ np.array([1, -1j])
        system = np.stack([flipped, np.ones_like(flipped)], axis=1)
        scale, origin = np.linalg.lstsq(system, places, rcond=None)[0].tolist()
        map_scale = crs.map_scale(*middle(latitude, longitude))
        return replace(self, crs=crs, scale=scale, origin=origin, map_scale=map_scale)

    def to_map(self, points: ArrayLike) -> FloatArray:
        """Easting and northing (N, 2), m, of pixels (N, 2) of the output."""
        matrix = self.pixel_to_map
        places: FloatArray = np.asarray(points, dtype=np.float64) @ matrix[:, :2].T + matrix[:, 2]
        return places

    def tiff_tags(self) -> list[ExtraTag]:
        """What makes a TIFF file a GeoTIFF."""
        a, b = self.scale.real, self.scale.imag
        # GeoTIFF counts from the corner of the first pixel.
        corner = self.origin - self.scale * (0.5 - 0.5j)
        # Version 1.1.0 and three keys: projected, pixels are areas, which system.
        keys = (1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, self.crs.epsg)
        if self.north_up:  # as more programs read it
            place = [
                (MODEL_SCALE, _DOUBLE, 3, (a, a, 0.0), True),
                (MODEL_TIEPOINT, _DOUBLE, 6, (0.0, 0.0, 0.0, corner.real, corner.imag, 0.0), True),
            ]
        else:
            matrix = (a, b, 0.0, corner.real, b, -a, 0.0, corner.imag, *(0.0,) * 7, 1.0)
            place = [(MODEL_TRANSFORMATION, _DOUBLE, len(matrix), matrix, True)]
        return [*place, (GEO_KEYS, _SHORT, len(keys), keys, True)]

    def world_file_texts(self) -> tuple[str, str]:
        """The contents of :func:`world_file_paths`."""
        numbers = self.pixel_to_map.T.ravel().tolist()
        return "".join(f"{number:.10f}\n" for number in numbers), self.crs.well_known_text() + "\n"


def _metres(value: float) -> str:
    """A length with its unit, to two digits, but no finer than a millimetre."""
    digits = max(0, min(3, 1 - math.floor(math.log10(value)))) if value > 0.0 and math.isfinite(value) else 1
    return f"{value:.{digits}f} m"


def world_file_paths(image: str | Path) -> tuple[Path, ...]:
    """The world file, and the coordinate system as .prj, of an image; none where its own format has a place for both.

    Deep Zoom images and OME-Zarr have none either: nothing that shows them would read it.
    """
    file = Path(image)
    kind = file.suffix.lower()
    if kind in (".tif", ".tiff", ".dzi", ".zarr"):
        return ()
    return file.with_suffix(f"{kind[:2]}{kind[-1]}w"), file.with_suffix(".prj")


def has_place(positions: Sequence[GpsPosition | None]) -> bool:
    """Check whether enough places are known; phones give several images the one that they found last."""
    known = {(position.latitude, position.longitude) for position in positions if position is not None}
    return len(known) >= MIN_POSITIONS


@dataclass(frozen=True, eq=False)
class Located:
    """Registered images, and what is known of where they are."""

    positions: Sequence[GpsPosition | None]
    cameras: Sequence[Camera]
    to_output: FloatArray  # (N, 3, 3): normalized undistorted coordinates of each image to pixels of the output
    names: Sequence[str]
    nadirs: Sequence[tuple[float, float, float] | None] = ()  # straight down by each camera's attitude, where known
    control: Sequence[Sequence[GroundControl]] = ()
    relief: float = 0.0  # pixels of the images that neighbours are off together: hills on what is mapped as a plane
    lever_std: float = 0.0  # how far hills move the ground against what is below the cameras, in heights; 0: not known
    # how far positions, by the number of their image, and control points, by name, put themselves where the images are
    leverage: Mapping[int | str, float] = field(default_factory=dict)


def georeference(located: Located, epsg: int | None = None, *, force: bool = False) -> tuple[Georeference | None, str]:
    """Place the output on the Earth, or say why that cannot be done; control points, where there are any, count alone.

    Without ``epsg`` the map is that of the control points, else UTM (UPS near the poles) on WGS 84. With ``force``
    positions that the images contradict place it too, and the reason says so.
    """
    points = [point for shown in located.control for point in shown]
    return (_by_control if any(not p.check for p in points) else _by_positions)(located, epsg, force)


def _by_positions(located: Located, epsg: int | None, force: bool) -> tuple[Georeference | None, str]:
    known = np.array([place is not None for place in located.positions])
    places = [place for place in located.positions if place is not None]
    if len(places) < MIN_POSITIONS:
        count = f"{len(places)} of {len(known)} images have a GPS position"
        return None, f"{count}, and {MIN_POSITIONS} are needed"
    different = len({(place.latitude, place.longitude) for place in places})
    if different == 1:
        return None, "all images have the same GPS position"
    views = views_of(located.cameras, located.to_output, located.nadirs).of(known)
    std = np.array([(np.nan, np.nan) if place.std is None else place.std for place in places])
    names = [name for name, is_known in zip(located.names, known.tolist(), strict=True) if is_known]
    leverage = [located.leverage.get(k, 0.0) for k in np.flatnonzero(known).tolist()]
    altitude = np.array([np.nan if place.altitude is None else place.altitude for place in places])
    return _placed(located, views, _MeasuredPlaces(GPS, names, places, altitude, std, leverage), epsg, force)


def _by_control(located: Located, epsg: int | None, force: bool) -> tuple[Georeference | None, str]:
    # A control point that several images show counts once, at the mean of where they have it.
    shown: dict[tuple[str, bool], list[tuple[GroundControl, complex]]] = {}
    for k, points in enumerate(located.control):
        for point in points:
            x, y = to_plane(located.cameras[k], located.to_output[k], np.array([point.pixel])).reshape(2)
            shown.setdefault((point.name, point.check), []).append((point, complex(x, -y)))
    means = {key: (same[0][0], complex(np.mean([pixel for _, pixel in same]))) for key, same in shown.items()}
    control = [mean for (_, check), mean in means.items() if not check]
    checks = [mean for (_, check), mean in means.items() if check]
    if len(control) < MIN_POSITIONS:
        return None, f"{len(control)} {CONTROL} are in the images, and {MIN_POSITIONS} are needed"
    if epsg is None and control[0][0].epsg != WGS84:
        epsg = control[0][0].epsg
    seen = views_of(located.cameras, located.to_output, located.nadirs)
    views = replace(Views.of_ground(np.array([pixel for _, pixel in control])), pixel=seen.pixel)
    std = np.array([[np.nan if point.std is None else point.std] * 2 for point, _ in control])
    names, places = [point.name for point, _ in control], [point.place for point, _ in control]
    leverage = [located.leverage.get(name, 0.0) for name in names]
    measured = _MeasuredPlaces(CONTROL, names, places, np.full(len(names), np.nan), std, leverage)
    place, reason = _placed(located, views, measured, epsg, force)
    if place is None or not checks:
        return place, reason
    latitude, longitude = np.array([(p.place.latitude, p.place.longitude) for p, _ in checks]).T
    right = place.crs.project(latitude, longitude)
    off = place.to_map([(pixel.real, -pixel.imag) for _, pixel in checks]) - right
    residuals = [
        Residual(p.name, east, north, True) for (p, _), (east, north) in zip(checks, off.tolist(), strict=True)
    ]
    return replace(place, checks=tuple(residuals)), reason


@dataclass(frozen=True, eq=False)
class _MeasuredPlaces:
    """What places the output: positions of N images, or control points."""

    source: PositionKind
    names: Sequence[str]
    places: Sequence[GpsPosition]
    altitude: FloatArray  # altitude, std, leverage: as :class:`rdstitch.export.map_fit.Measured` has them
    std: FloatArray
    leverage: Sequence[float]


def _placed(
    located: Located, views: Views, measured: _MeasuredPlaces, epsg: int | None, force: bool
) -> tuple[Georeference | None, str]:
    """Place the output by some positions."""
    latitude, longitude = np.array([(place.latitude, place.longitude) for place in measured.places]).T
    crs = Crs.nearest(latitude, longitude) if epsg is None else Crs(epsg)
    map_scale = crs.map_scale(*middle(latitude, longitude))
    places = crs.project(latitude, longitude) @ np.array([1, 1j])
    usable: BoolArray = np.isfinite(places) & views.usable
    source, names = measured.source, measured.names
    if usable.sum() < MIN_POSITIONS:
        return None, f"{crs.name} does not reach the {source}"
    on_map = Measured(places, measured.altitude, measured.std, np.array(measured.leverage), map_scale)
    fit = fit_map(views.of(usable), on_map.of(usable))
    used = np.zeros(len(names), dtype=bool)
    used[usable] = fit.used
    off = np.full(len(names), complex(np.inf))
    off[usable] = fit.left_out
    if not used.any():
        return None, f"no scale and direction of the map fit the {source} and the places of the images"
    rms = math.sqrt(float(np.mean(np.abs(off[used]) ** 2)))
    spread = math.sqrt(float(np.mean(np.abs(places[used] - places[used].mean()) ** 2)))
    reason = ""
    if used.sum() < max(MIN_POSITIONS, len(names) / 2) or not rms < _MAX_ERROR * spread:
        median = float(np.median(np.abs(off)))
        reason = (
            f"the {source} contradict the images: half of them are {_metres(median)} or more from where the images put "
            f"them, which is much in an area of {_metres(2.0 * spread)}"
        )
        if not force:
            return None, f"{reason}; --georeference force places it nevertheless"
    residuals = tuple(Residual(n, e.real, e.imag, u) for n, e, u in zip(names, off, used.tolist(), strict=True))
    assumption = _assumption(views, fit) if source == GPS else ""
    hills = located.relief * views.pixel
    if located.lever_std and np.isfinite(views.height).any():
        hills = located.lever_std * float(np.nanmedian(views.height))
    std = None if fit.std is None else math.hypot(fit.std, hills * abs(fit.scale))
    place = Georeference(
        crs, fit.scale, fit.origin, rms, source, residuals, std, map_scale=map_scale, assumption=assumption
    )
    return place, reason


def _assumption(views: Views, fit: MapFit) -> str:
    """What was assumed of where cameras are, and how far that may shift the map."""
    if views.known == "centres":
        shift = _metres(float(np.median(views.height)) * abs(fit.scale) * math.radians(1.0))
        return (
            "the images have no poses: GPS positions are taken for those of the image centres, and each degree that "
            f"the cameras were tilted together shifts the map by {shift}"
        )
    return ""
