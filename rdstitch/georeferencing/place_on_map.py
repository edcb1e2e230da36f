"""Placing the output on the Earth, by the images' positions or ground control points."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.crs import WGS84, Crs, middle
from rdstitch.geometry.places import GpsPosition, GroundControl
from rdstitch.geometry.radial_homography import to_plane
from rdstitch.georeferencing.camera_views import Views, as_complex, views_of
from rdstitch.georeferencing.georeference import CONTROL, GPS, Georeference, PositionKind, Residual, metres
from rdstitch.georeferencing.map_fit import MapFit, Measured, fit_map
from rdstitch.inputs.source import Source

MIN_POSITIONS = 3

# Positions must agree with the images to this share of their own spread: else it is no view from above, or the GPS
# says less than nothing.
_MAX_ERROR = 0.25


def has_place(sources: Sequence[Source]) -> bool:
    """Whether control points or enough places are known; phones give several images the one that they found last."""
    places = [source.metadata.gps for source in sources]
    known = {(place.latitude, place.longitude) for place in places if place is not None}
    return len(known) >= MIN_POSITIONS or any(source.control for source in sources)


@dataclass(frozen=True, eq=False)
class Located:
    """Registered images, and what is known of where they are."""

    positions: Sequence[GpsPosition | None]
    cameras: Sequence[Camera]
    to_output: FloatArray  # (N, 3, 3): normalized undistorted coordinates of each image to pixels of the output
    names: Sequence[str]
    nadirs: Sequence[tuple[float, float, float] | None]  # straight down by each camera's attitude, where known
    control: Sequence[Sequence[GroundControl]] = ()
    relief: float = 0.0  # pixels of the images that neighbours are off together: hills on what is mapped as a plane
    lever_std: float = 0.0  # how far hills move the ground against what is below the cameras, in heights; 0: not known
    # how far positions, by the number of their image, and control points, by name, put themselves where the images are
    leverage: Mapping[int | str, float] = field(default_factory=dict)


def place_on_map(located: Located, epsg: int | None = None, *, force: bool = False) -> tuple[Georeference | None, str]:
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
            pixel = as_complex(to_plane(located.cameras[k], located.to_output[k], np.array([point.pixel])))[0]
            shown.setdefault((point.name, point.check), []).append((point, complex(pixel)))
    means = {
        key: (same[0][0], complex(np.mean([pixel for _, pixel in same if np.isfinite(pixel)] or [np.nan])))
        for key, same in shown.items()
    }
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
    residuals = (
        Residual.of(point.name, complex(*error), used=True)
        for (point, _), error in zip(checks, off.tolist(), strict=True)
    )
    return replace(place, checks=tuple(residuals)), reason


@dataclass(frozen=True, eq=False)
class _MeasuredPlaces:
    """What places the output: positions of N images, or control points."""

    source: PositionKind
    names: Sequence[str]
    places: Sequence[GpsPosition]
    altitude: FloatArray  # altitude, std, leverage: as :class:`rdstitch.georeferencing.map_fit.Measured` has them
    std: FloatArray
    leverage: Sequence[float]


def _placed(
    located: Located, views: Views, measured: _MeasuredPlaces, epsg: int | None, force: bool
) -> tuple[Georeference | None, str]:
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
            f"the {source} contradict the images: half of them are {metres(median)} or more from where the images put "
            f"them, which is much in an area of {metres(2.0 * spread)}"
        )
        if not force:
            return None, f"{reason}; --georeference force places it nevertheless"
    residuals = tuple(map(Residual.of, names, off.tolist(), used.tolist()))
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
        shift = metres(float(np.median(views.height)) * abs(fit.scale) * math.radians(1.0))
        return (
            "the images have no poses: GPS positions are taken for those of the image centres, and each degree that "
            f"the cameras were tilted together shifts the map by {shift}"
        )
    return ""
