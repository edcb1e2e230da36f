"""The canvas of images taken by turning on the spot: projection, size, a full turn."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.choices import ProjectionName
from rdstitch.compositing.canvas import (
    Canvas,
    canvas_between,
    check_placement,
    plan_canvas,
    refuse_scale,
    turned_and_scaled,
)
from rdstitch.compositing.projection import PLANE, PROJECTIONS, TURN, Projection
from rdstitch.errors import ArgumentError, LimitError
from rdstitch.geometry.camera import Camera, points_over
from rdstitch.geometry.radial_homography import from_directions, to_directions

_POINTS_PER_SIDE = 64
_GRID = 33  # points along each side of an image, over all of it
_PROBES = 2048  # of a turn: a sixth of a degree
# Radians: the view up to which a plane shows it without much stretching, and the height up to which a cylinder does.
_PLANE_VIEW = math.radians(90.0)
_CYLINDER_HEIGHT = math.radians(70.0)
# A full turn is a multiple of this many pixels, or of less than 1/256 of it, so that both ends of a canvas have the
# same lattices, reduced pixels and bands.
_UNIT, _UNITS_PER_TURN = 32, 256


@dataclass(frozen=True, eq=False)
class SeenDirections:
    """What images show of the directions around their centre."""

    # (K, 2): longitude and latitude of each image's border, radians; longitudes without a jump, around that of the
    # image
    outlines: tuple[FloatArray, ...]
    around: bool  # whether they go all the way round
    # longitude at the left border of a full turn: that of the reference image's back, or where a gap is open
    start: float = -np.pi

    @property
    def extent(self) -> tuple[float, float]:
        """Width and height of the field of view, radians."""
        low, high = self.bounds
        return (TURN if self.around else float(high[0] - low[0])), float(high[1] - low[1])

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Least and largest longitude and latitude."""
        everything = np.concatenate(self.outlines)
        return everything.min(axis=0), everything.max(axis=0)


def seen_directions(cameras: Sequence[Camera], directions: FloatArray) -> SeenDirections:
    """What images show, by what takes their undistorted normalized coordinates to directions, (N, 3, 3)."""
    outlines = [_outline(camera, matrix) for camera, matrix in zip(cameras, directions, strict=True)]
    low = np.array([outline[:, 0].min() for outline in outlines])
    high = np.array([outline[:, 0].max() for outline in outlines])
    gap = _widest_gap(low, high)
    start = _gap_between(cameras, directions) if gap is None else gap
    if start is None:
        return SeenDirections(tuple(outlines), True)
    # From the middle of what nobody shows on, everything is in one piece.
    shifts = np.floor((0.5 * (low + high) - start) / TURN) * TURN
    moved = [outline - (shift, 0.0) for outline, shift in zip(outlines, shifts, strict=True)]
    if gap is None:
        return SeenDirections(tuple(moved), True, start)
    back = np.rint(np.mean([outline[:, 0].mean() for outline in moved]) / TURN) * TURN
    return SeenDirections(tuple(outline - (back, 0.0) for outline in moved), False)


def choose_projection(seen: SeenDirections) -> Projection:
    """The plane for what fits on it, the cylinder for what is wide and low, the sphere for the rest.

    A full turn is always shown on the sphere, since viewers that turn it know no other projection.
    """
    low, high = seen.bounds
    steepest = float(max(-low[1], high[1]))
    if max(seen.extent) <= _PLANE_VIEW and steepest <= _PLANE_VIEW / 2:
        return PLANE
    return PROJECTIONS["cylinder" if not seen.around and 2.0 * steepest <= _CYLINDER_HEIGHT else "sphere"]


def plan_panorama(
    cameras: Sequence[Camera],
    directions: FloatArray,
    *,
    projection: ProjectionName = "auto",
    scale: float = 1.0,
    rotate: float = 0.0,
    reference: int | None = None,
    names: Sequence[str] | None = None,
    max_stretch: float = math.inf,
) -> Canvas:
    """Plan the canvas that holds every image of a panorama.

    Arguments are those of :func:`rdstitch.compositing.plan_canvas`. What the projection would stretch more than
    ``max_stretch`` times has no place on it: the ends of a plane, the top and the bottom of a cylinder.
    """
    called = [f"image {k + 1}" for k in range(len(cameras))] if names is None else list(names)
    check_placement(cameras, directions, scale, rotate, reference, called, max_stretch)
    if projection != "auto" and projection not in PROJECTIONS:
        raise ArgumentError(f"projection must be one of auto, {', '.join(PROJECTIONS)}, not {projection!r}")
    seen = seen_directions(cameras, directions)
    chosen = choose_projection(seen) if projection == "auto" else PROJECTIONS[projection]
    if chosen == PLANE:
        return plan_canvas(
            cameras, directions, scale=scale, rotate=rotate, reference=reference, names=names, max_stretch=max_stretch
        )
    lengths = np.linalg.norm(directions, axis=1)
    focal = lengths[:, 2] / lengths[:, 0] * [camera.scale for camera in cameras]
    resolution = scale * float(np.median(focal) if reference is None else focal[reference])
    extent = np.array(chosen.extent(max_stretch))
    if chosen.periodic:
        outlines = [_places(outline, chosen) for outline in seen.outlines]
    else:
        outlines = [_flat_outline(*image, chosen, extent) for image in zip(cameras, directions, strict=True)]
    for outline, name in zip(outlines, called, strict=True):
        if not (outline.min(axis=0) < extent).all() or not (outline.max(axis=0) > -extent).all():
            raise LimitError(
                f"{name}: looks so far to the side that all of it would be stretched beyond the limit; "
                "use --projection sphere, or raise --max-stretch"
            )
    start = seen.start if seen.around and chosen.periodic else None
    canvas = _lay_out([np.clip(outline, -extent, extent) for outline in outlines], start, resolution, rotate)
    refuse_scale(cameras, np.array(canvas.size, dtype=np.float64))
    return replace(canvas, projection=chosen)


def _lay_out(outlines: Sequence[FloatArray], start: float | None, resolution: float, rotate: float) -> Canvas:
    """The canvas that holds the places (K, 2) of images.

    ``start`` is the longitude at the left border of a full turn, or None; ``resolution`` in pixels per radian ahead.
    """
    if start is not None and rotate:
        raise ArgumentError("a panorama that goes all the way round cannot be turned; leave out --rotate")
    period = None
    if start is not None:
        width = TURN * resolution
        unit = max(_UNIT, 1 << int(math.log2(max(width / _UNITS_PER_TURN, 1.0))))
        period = float(math.ceil(width / unit) * unit)
        resolution = period / TURN
    linear = turned_and_scaled(rotate, resolution)
    placed = [outline @ linear.T for outline in outlines]
    everything = np.concatenate(placed)
    low, high = everything.min(axis=0), everything.max(axis=0)
    if start is not None and period is not None:
        low[0], high[0] = start * resolution, start * resolution + period
    return replace(canvas_between(low, high, linear, placed), period=period)


def _flat_outline(camera: Camera, matrix: FloatArray, projection: Projection, extent: FloatArray) -> FloatArray:
    """Places (K, 2) of an image's border, or of a box around it where that does not enclose what the image shows."""
    border, inside = (
        places[np.isfinite(places).all(axis=1)]
        for points in (camera.outline(_POINTS_PER_SIDE), points_over(camera.image_size, _GRID))
        for places in [projection.project(to_directions(camera, matrix, points))]
    )
    if not (np.abs(inside) < extent).all(axis=1).any():
        return np.full((1, 2), np.inf)  # nowhere
    border, inside = np.clip(border, -extent, extent), np.clip(inside, -extent, extent)
    low, high = inside.min(axis=0), inside.max(axis=0)
    if (low >= border.min(axis=0)).all() and (high <= border.max(axis=0)).all():
        return border
    return np.array([low, (high[0], low[1]), high, (low[0], high[1])])


def _outline(camera: Camera, matrix: FloatArray) -> FloatArray:
    """Longitude and latitude (K, 2) of an image's border, and of the pole that it shows with all longitudes."""
    rays = to_directions(camera, matrix, camera.outline(_POINTS_PER_SIDE))
    ahead = matrix[:, 2]
    middle = math.atan2(ahead[0], ahead[2])
    longitude = middle + np.mod(np.arctan2(rays[:, 0], rays[:, 2]) - middle + np.pi, TURN) - np.pi
    latitude = np.arctan2(rays[:, 1], np.hypot(rays[:, 0], rays[:, 2]))
    poles = [sign for sign in (-1.0, 1.0) if _shows(camera, matrix, np.array([[0.0, sign, 0.0]]))[0]]
    if not poles:
        return np.stack([longitude, latitude], axis=1)
    top = -np.pi / 2 if -1.0 in poles else float(latitude.min())
    bottom = np.pi / 2 if 1.0 in poles else float(latitude.max())
    left, right = middle - np.pi, middle + np.pi
    return np.array([(left, top), (right, top), (right, bottom), (left, bottom)])


def _shows(camera: Camera, matrix: FloatArray, directions: FloatArray) -> BoolArray:
    """Which directions (K, 3) an image shows."""
    points, (width, height) = from_directions(camera, matrix, directions), camera.image_size
    return np.asarray(((points >= -0.5) & (points <= (width - 0.5, height - 0.5))).all(axis=1))


def _gap_between(cameras: Sequence[Camera], directions: FloatArray) -> float | None:
    """Middle of the widest range of longitudes that no image shows at their middle latitude; None if there is none.

    A full turn that is not quite closed has such a gap even where the corners of images meet above and below it.
    """
    ahead = directions[:, :, 2]
    latitude = float(np.median(np.arctan2(ahead[:, 1], np.hypot(ahead[:, 0], ahead[:, 2]))))
    longitude = (np.arange(_PROBES) + 0.5) * (TURN / _PROBES) - np.pi
    level = np.stack([np.sin(longitude), np.full(_PROBES, math.tan(latitude)), np.cos(longitude)], axis=1)
    seen = np.any([_shows(camera, matrix, level) for camera, matrix in zip(cameras, directions, strict=True)], axis=0)
    shown = longitude[seen]
    widths = np.diff(shown, append=shown[:1] + TURN)
    if not len(shown) or widths.max() < 1.5 * TURN / _PROBES:
        return None
    widest = int(np.argmax(widths))
    return float(np.remainder(shown[widest] + widths[widest] / 2.0 + np.pi, TURN) - np.pi)


def _places(outline: FloatArray, projection: Projection) -> FloatArray:
    """Places (K, 2) of longitudes and latitudes, with the longitudes as they are."""
    level = np.stack([np.zeros(len(outline)), np.sin(outline[:, 1]), np.cos(outline[:, 1])], axis=1)
    return np.stack([outline[:, 0], projection.project(level)[:, 1]], axis=1)


def _widest_gap(low: FloatArray, high: FloatArray) -> float | None:
    """Middle of the widest range of longitudes that no interval covers, radians; None where all are covered."""
    if float((high - low).max()) >= TURN:
        return None
    order = np.argsort(np.mod(low, TURN), kind="stable")
    start, length = np.mod(low, TURN)[order], (high - low)[order]
    # Once round, the intervals begin again.
    reach = np.maximum.accumulate(np.concatenate([start + length - TURN, start + length]))[len(start) - 1 : -1]
    gaps = start - reach
    widest = int(np.argmax(gaps))
    return float(start[widest] - gaps[widest] / 2.0) if gaps[widest] > 0.0 else None


def directions_on(canvas: Canvas, points: FloatArray) -> FloatArray:
    """Directions (N, 3), of length 1, of canvas pixels (N, 2) of images taken by turning on the spot."""
    places = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(canvas.matrix).T
    parts = canvas.projection.directions(places[:, 0], places[:, 1])
    directions = np.stack(np.broadcast_arrays(*parts), axis=-1)
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def field_of_view(canvas: Canvas) -> tuple[float, float]:
    """Angles that the middle row and the middle column of a canvas span, radians."""
    width, height = canvas.size
    x, y = (width - 1) / 2, (height - 1) / 2
    # At a pole, rounding must not lead beyond it.
    down = _angle_along(canvas, [(x, -0.5 + 1e-6), (x, y), (x, height - 0.5 - 1e-6)])
    if canvas.projection.periodic:
        return width / math.hypot(canvas.matrix[0, 0], canvas.matrix[1, 0]), down
    return _angle_along(canvas, [(-0.5, y), (x, y), (width - 0.5, y)]), down


def _angle_along(canvas: Canvas, points: Sequence[tuple[float, float]]) -> float:
    """Sum of the angles from each canvas pixel to the next, radians."""
    directions = directions_on(canvas, np.array(points))
    cosines = (directions[1:] * directions[:-1]).sum(axis=1)
    return float(np.arccos(np.clip(cosines, -1.0, 1.0)).sum())


def center_of_view(canvas: Canvas) -> tuple[float, float]:
    """Longitude, to the right, and latitude, downwards, of the middle of a canvas, radians."""
    width, height = canvas.size
    x, y, z = directions_on(canvas, np.array([((width - 1) / 2, (height - 1) / 2)]))[0]
    return math.atan2(x, z), math.asin(max(-1.0, min(1.0, float(y))))
