"""Placing the output on the Earth, by the images' positions or ground control points."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.geometry.crs import WGS84, Crs, middle
from rdstitch.geometry.places import GpsPosition, GroundControl
from rdstitch.geometry.radial_homography import to_plane
from rdstitch.georeferencing.camera_views import Views, as_complex, views_of
from rdstitch.georeferencing.georeference import Georeference, PositionKind, Residual, metres
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
class AlignmentErrors:
    """What the alignment of N images says of its own errors."""

    relief: float = 0.0  # pixels of the images that neighbours are off together: hills on what is mapped as a plane
    # how far hills move the ground against what is below the cameras, in heights; None where that is not known
    lever_std: float | None = None
    # how far positions, of the images and of control points by name, put themselves where the images are, 0 to 1
    leverage: Sequence[float] = ()
    control_leverage: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class MapPlacement:
    """Where an output lies on the Earth, or why that is not known."""

    place: Georeference | None
    reason: str = ""  # why there is none
    cautions: tuple[str, ...] = ()  # what speaks against it, or was not used


def place_on_map(
    sources: Sequence[Source],
    to_output: FloatArray,
    errors: AlignmentErrors,
    epsg: int | None = None,
    *,
    force: bool = False,
) -> MapPlacement:
    """Place the output on the Earth, or say why that cannot be done; control points count alone where they suffice.

    ``sources`` are the N images that are used, with the cameras that were found; ``to_output`` (N, 3, 3) leads from
    normalized undistorted coordinates of each to pixels of the output. Without ``epsg`` the map is that of the control
    points, else UTM (UPS near the poles) on WGS 84. With ``force`` positions that the images contradict place it too.
    """
    points = _control_points(sources, to_output)
    control = [(point, pixel) for point, pixel in points if not point.check]
    located = sum(source.metadata.gps is not None for source in sources)
    by_control = len(control) >= MIN_POSITIONS
    few = f"{len(control)} {PositionKind.CONTROL} are in the images, and {MIN_POSITIONS} are needed"
    if not by_control and located < MIN_POSITIONS:
        no_gps = f"{located} of {len(sources)} images have a GPS position, and {MIN_POSITIONS} are needed"
        return MapPlacement(None, few if control else no_gps)
    views = views_of([source.camera for source in sources], to_output, [source.down for source in sources])
    if epsg is None and control and control[0][0].epsg != WGS84:
        epsg = control[0][0].epsg
    known = _of_control(control, views, errors) if by_control else _of_positions(sources, views, errors)
    found = _placed(known, errors, epsg, force)
    if control and not by_control:
        caution = f"{few}: GPS positions place the map, and these check it"
        found = replace(found, cautions=(*found.cautions, caution))
    place, checks = found.place, [(point, pixel) for point, pixel in points if point.check or not by_control]
    if place is None or not checks:
        return found
    latitude, longitude = np.array([(point.place.latitude, point.place.longitude) for point, _ in checks]).T
    off = place.to_map([(pixel.real, -pixel.imag) for _, pixel in checks]) - place.crs.project(latitude, longitude)
    residuals = (Residual.of(p.name, complex(*error), True) for (p, _), error in zip(checks, off.tolist(), strict=True))
    return replace(found, place=replace(place, checks=tuple(residuals)))


@dataclass(frozen=True, eq=False)
class _KnownPlaces:
    """N places that are known: of cameras, or of control points."""

    source: PositionKind
    names: Sequence[str]
    places: Sequence[GpsPosition]
    views: Views
    leverage: FloatArray  # (N,)


def _of_positions(sources: Sequence[Source], views: Views, errors: AlignmentErrors) -> _KnownPlaces:
    places = {k: source.metadata.gps for k, source in enumerate(sources) if source.metadata.gps is not None}
    known = np.array(list(places), dtype=np.intp)
    leverage = np.array(errors.leverage or [0.0] * len(sources))[known]
    return _KnownPlaces(
        PositionKind.GPS, [sources[k].name for k in places], list(places.values()), views.take(known), leverage
    )


def _of_control(
    control: Sequence[tuple[GroundControl, complex]], views: Views, errors: AlignmentErrors
) -> _KnownPlaces:
    stds = [None if point.std is None else (point.std, point.std) for point, _ in control]
    places = [replace(point.place, altitude=None, std=std) for (point, _), std in zip(control, stds, strict=True)]
    names = [point.name for point, _ in control]
    leverage = np.array([errors.control_leverage.get(name, 0.0) for name in names])
    ground = Views.of_ground(np.array([pixel for _, pixel in control]), views.pixel)
    return _KnownPlaces(PositionKind.CONTROL, names, places, ground, leverage)


def _control_points(sources: Sequence[Source], to_output: FloatArray) -> list[tuple[GroundControl, complex]]:
    """Each point once, with its place in the output: where several images show it, at the mean of these."""
    shown: dict[tuple[str, bool], list[tuple[GroundControl, complex]]] = {}
    for source, homography in zip(sources, to_output, strict=True):
        for point in source.control:
            pixel = as_complex(to_plane(source.camera, homography, np.array([point.pixel])))[0]
            shown.setdefault((point.name, point.check), []).append((point, complex(pixel)))
    return [
        (same[0][0], complex(np.mean([pixel for _, pixel in same if np.isfinite(pixel)] or [np.nan])))
        for same in shown.values()
    ]


def _placed(known: _KnownPlaces, errors: AlignmentErrors, epsg: int | None, force: bool) -> MapPlacement:
    source, names, views = known.source, known.names, known.views
    latitude, longitude = np.array([(place.latitude, place.longitude) for place in known.places]).T
    if source is PositionKind.GPS and not (np.ptp(latitude) or np.ptp(longitude)):
        return MapPlacement(None, "all images have the same GPS position")
    crs = Crs.nearest(latitude, longitude) if epsg is None else Crs(epsg)
    map_scale = crs.map_scale(*middle(latitude, longitude))
    places = crs.project(latitude, longitude) @ np.array([1, 1j])
    usable: BoolArray = np.isfinite(places) & np.isfinite(views.foot)
    if usable.sum() < MIN_POSITIONS:
        return MapPlacement(None, f"{crs.name} does not reach the {source}")
    altitude = np.array([np.nan if place.altitude is None else place.altitude for place in known.places])
    std = np.array([(np.nan, np.nan) if place.std is None else place.std for place in known.places])
    measured = Measured(places[usable], altitude[usable], std[usable], known.leverage[usable], map_scale)
    fit = fit_map(views.take(usable), measured)
    used, off = np.zeros(len(names), dtype=bool), np.full(len(names), complex(np.nan))
    used[usable], off[usable] = fit.used, fit.left_out
    if not used.any():
        return MapPlacement(None, f"no scale and direction of the map fit the {source} and the places of the images")
    rms = math.sqrt(float(np.mean(np.abs(off[used]) ** 2)))
    spread = math.sqrt(float(np.mean(np.abs(places[used] - places[used].mean()) ** 2)))
    contradiction = ""
    if used.sum() < max(MIN_POSITIONS, len(names) / 2) or not rms < _MAX_ERROR * spread:
        median = float(np.median(np.where(usable, np.abs(off), np.inf)))
        contradiction = (
            f"the {source} contradict the images: half of them are {metres(median)} or more from where the images put "
            f"them, which is much in an area of {metres(2.0 * spread)}"
        )
        if not force:
            return MapPlacement(None, f"{contradiction}; --georeference force places it nevertheless")
    hills = errors.relief * views.pixel
    if errors.lever_std is not None and np.isfinite(views.height).any():
        hills = errors.lever_std * float(np.nanmedian(views.height))
    place = Georeference(
        crs,
        fit.scale,
        fit.origin,
        rms,
        source,
        residuals=tuple(map(Residual.of, names, off.tolist(), used.tolist())),
        std=None if fit.std is None else math.hypot(fit.std, hills * abs(fit.scale)),
        scale_std=fit.scale_std,
        map_scale=map_scale,
        assumption=_assumption(views, fit) if source is PositionKind.GPS else "",
    )
    return MapPlacement(place, cautions=(contradiction,) if contradiction else ())


def _assumption(views: Views, fit: MapFit) -> str:
    """What was assumed of where cameras are, and how far that may shift the map."""
    if views.known != "centres":
        return ""
    shift = metres(float(np.median(views.height)) * abs(fit.scale) * math.radians(1.0))
    return (
        "the images have no poses: GPS positions are taken for those of the image centres, and each degree that "
        f"the cameras were tilted together shifts the map by {shift}"
    )
