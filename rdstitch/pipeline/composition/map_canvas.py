"""The canvas of the output; north up, with the requested ground sample distance, if it is georeferenced."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.compositing import Canvas, CompositeOptions, plan_canvas, plan_panorama
from rdstitch.compositing.boxes import encloses
from rdstitch.compositing.canvas import refuse_scale
from rdstitch.errors import ArgumentError
from rdstitch.geometry.crs import Crs
from rdstitch.georeferencing.georeference import Georeference
from rdstitch.georeferencing.map_grid import MapGrid, grid_of_extent, read_grid
from rdstitch.georeferencing.place_on_map import MIN_POSITIONS, MapPlacement, has_place, place_on_map
from rdstitch.inputs.source import Source
from rdstitch.results.placed_images import PlacedImages, SavedGrid

_SAME_PIXELS = 1e-6  # pixels that two grids may be off: rounding


def check_map(sources: Sequence[Source], options: CompositeOptions) -> None:
    """Refuse early what the options request of a map without a known place."""
    if options.epsg is not None:
        Crs(options.epsg)
    if options.like is not None:
        read_grid(options.like)
    wanted = {"gsd": options.gsd, "crs": options.epsg, "like": options.like, "extent": options.extent}
    for name, value in wanted.items():
        if value is not None and options.georeference == "off" and name != "crs":  # that is of positions too
            raise ArgumentError(f"{name} needs a georeferenced output, but georeference is off; leave one of them out")
        if value is not None and not has_place(sources):
            raise ArgumentError(
                f"{name} needs GPS positions of {MIN_POSITIONS} images, in EXIF or a file, or ground control points; "
                "leave it out"
            )


def output_canvas(placed: PlacedImages, options: CompositeOptions) -> Canvas:
    """The canvas of the images, no larger than ``options.max_size``."""
    canvas = _canvas(placed, options, options.scale)
    if placed.grid is not None:
        return _on_saved_grid(canvas, placed, placed.grid, cropped=options.crop == "auto")
    if options.max_size is None or max(canvas.size) <= options.max_size:
        return canvas
    # The canvas has whole pixels around the images, and a full turn a multiple of some: these may be too many.
    spare = 1 if canvas.period is None else max(32, options.max_size // 128)
    return _canvas(placed, options, options.scale * max(options.max_size - spare, 1) / max(canvas.size))


def _canvas(placed: PlacedImages, options: CompositeOptions, scale: float) -> Canvas:
    """The canvas on a plane or, for a pure rotation, in a projection."""
    if not placed.turned and options.projection not in ("auto", "plane"):
        raise ArgumentError(
            f"the {options.projection} projection is for images taken by turning on the spot; these were not, "
            "leave out --projection"
        )
    planner = partial(plan_panorama, projection=options.projection) if placed.turned else plan_canvas
    canvas = planner(
        placed.cameras,
        placed.homographies,
        scale=scale,
        rotate=options.rotate,
        reference=placed.reference,
        names=[source.name for source in placed.sources],
        max_stretch=options.max_stretch,
    )
    return replace(canvas, orientation=placed.orientation)


def canvas_on_map(placed: PlacedImages, options: CompositeOptions) -> tuple[Canvas, MapPlacement]:
    """The canvas, and its place on the Earth."""
    canvas = output_canvas(placed, options)
    found = _placement(placed, canvas, options)
    if (place := found.place) is None:
        for name in ("gsd", "like", "extent"):
            if getattr(options, name) is not None:
                reason = found.reason or "that is off"
                raise ArgumentError(f"{name} needs a georeferenced output: {reason}; leave it out")
        return canvas, found
    if placed.grid is not None:
        saved = placed.grid.place
        on_canvas = saved and saved.after(canvas.matrix @ np.linalg.inv(placed.grid.from_plane))
        return canvas, replace(found, place=on_canvas)
    if (grid := _grid(options, place)) is not None:
        on_grid = grid.place.in_pixels(place) @ canvas.matrix
        laid = _on_grid(canvas, placed, on_grid, grid.size)
        if not any(_overlaps(outline, grid.size) for outline in laid.footprints):
            raise ArgumentError(f"none of the images lies within {options.like or 'the extent'}")
        # As in the file, without rounding.
        exact = replace(place.after(grid.place.in_pixels(place)), scale=grid.place.scale, origin=grid.place.origin)
        return laid, replace(found, place=exact)
    rotate, scale = options.rotate, options.scale
    if options.north_up and not rotate and not options.upright:
        rotate = place.clockwise_deg
    if options.gsd is not None:
        scale *= place.gsd / options.gsd
    laid = canvas
    if (rotate, scale) != (options.rotate, options.scale):
        laid = output_canvas(placed, replace(options, rotate=rotate, scale=scale, gsd=None))
    return laid, replace(found, place=place_on_canvas(place, canvas, laid))


def _placement(placed: PlacedImages, canvas: Canvas, options: CompositeOptions) -> MapPlacement:
    """The place of a canvas on the Earth."""
    if options.georeference == "off":
        return MapPlacement(None)
    if placed.turned:
        return MapPlacement(None, "the camera turned on the spot")
    epsg = options.epsg if options.like is None else read_grid(options.like).place.crs.epsg
    if placed.place is None:
        to_output = canvas.matrix @ placed.homographies
        return place_on_map(placed.sources, to_output, placed.errors, epsg, force=options.georeference == "force")
    place = placed.place.after(canvas.matrix)
    return MapPlacement(place if epsg is None else place.in_system(Crs(epsg), np.concatenate(canvas.footprints)))


def _grid(options: CompositeOptions, place: Georeference) -> MapGrid | None:
    """The grid that the options request."""
    if options.like is not None:
        grid = read_grid(options.like)
        return grid if options.extent is None else grid.within(options.extent)
    if options.extent is None:
        return None
    return grid_of_extent(place.crs, options.extent, (options.gsd or place.gsd) * place.map_scale)


def _on_saved_grid(canvas: Canvas, placed: PlacedImages, grid: SavedGrid, *, cropped: bool) -> Canvas:
    """The canvas cropped to the pixels of an earlier output; exactly these pixels if it does not cover them."""
    to_grid = grid.from_plane @ np.linalg.inv(canvas.matrix)
    left, top = np.rint(-to_grid[:2, 2]).astype(int).tolist()
    shift = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, 1.0]])
    box = left, top, left + grid.size[0], top + grid.size[1]
    if cropped and np.abs(to_grid - shift).max() < _SAME_PIXELS and encloses((0, 0, *canvas.size), box):
        return replace(canvas, cropped_to=box)
    return replace(_on_grid(canvas, placed, grid.from_plane, grid.size), cropped_to=(0, 0, *grid.size))


def _on_grid(canvas: Canvas, placed: PlacedImages, from_plane: FloatArray, size: tuple[int, int]) -> Canvas:
    refuse_scale(placed.cameras, size, "choose a smaller extent, or larger pixels")
    return canvas.on_grid(from_plane, size)


def _overlaps(outline: FloatArray, size: tuple[int, int]) -> bool:
    return bool((outline.max(axis=0) > 0).all() and (outline.min(axis=0) < size).all())


def place_on_canvas(place: Georeference | None, one: Canvas, other: Canvas) -> Georeference | None:
    """The place of another canvas of the same plane."""
    if place is None or np.array_equal(one.matrix, other.matrix):  # without rounding: grids are compared
        return place
    return place.after(other.matrix @ np.linalg.inv(one.matrix))
