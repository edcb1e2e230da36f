"""The canvas of georeferenced images: north up, and of the ground sample distance that was requested."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rdstitch.compositing import Canvas, CompositeOptions
from rdstitch.errors import ArgumentError
from rdstitch.export.georeference import MIN_POSITIONS, Georeference, georeference, has_place
from rdstitch.geometry.crs import Crs
from rdstitch.inputs.source import Source
from rdstitch.pipeline.placed_images import PlacedImages, plan
from rdstitch.results.messages import MAX_NAMED, Message


def check_map(sources: Sequence[Source], options: CompositeOptions) -> None:
    """Find out before long work whether what is requested of the map can be had."""
    if options.epsg is not None:
        Crs(options.epsg)
    placed = has_place([source.metadata.gps for source in sources]) or any(source.control for source in sources)
    for name, value in (("gsd", options.gsd), ("crs", options.epsg)):
        if value is not None and not placed:
            raise ArgumentError(
                f"{name} needs GPS positions of {MIN_POSITIONS} images, in EXIF or a file, or ground control points; "
                "leave it out"
            )


def plan_on_map(placed: PlacedImages, options: CompositeOptions) -> tuple[Canvas, Georeference | None, str]:
    """The canvas with its place on the Earth, or why it has none."""
    canvas = plan(placed, options)
    if placed.turned:
        place, reason = None, "the camera turned on the spot"
    elif placed.place is not None and options.epsg in (None, placed.place.crs.epsg):
        place, reason = placed.place.after(canvas.matrix), ""
    else:
        names = [source.name for source in placed.sources]
        to_output = canvas.matrix @ placed.homographies
        control = [source.control for source in placed.sources]
        place, reason = georeference(placed.positions, placed.cameras, to_output, names, options.epsg, control)
    if place is None:
        if options.gsd is not None:
            raise ArgumentError(f"gsd needs a georeferenced output: {reason}; leave it out")
        return canvas, None, reason
    rotate, scale = options.rotate, options.scale
    if options.north_up and not rotate and not options.upright:
        rotate = place.clockwise_deg
    if options.gsd is not None:
        scale *= place.gsd / options.gsd
    laid = (
        canvas
        if (rotate, scale) == (options.rotate, options.scale)
        else plan(placed, replace(options, rotate=rotate, scale=scale, gsd=None))
    )
    return laid, moved(place, canvas, laid), ""


def moved(place: Georeference | None, one: Canvas, other: Canvas) -> Georeference | None:
    """The place of another canvas of the same plane."""
    return None if place is None else place.after(other.matrix @ np.linalg.inv(one.matrix))


def place_messages(place: Georeference | None, reason: str, placed: PlacedImages) -> list[Message]:
    """What the user should know of the place; nothing where hardly an image has a position."""
    if place is None:
        return [Message(f"not georeferenced: {reason}")] if placed.has_place else []
    messages = [Message(place.summary, severity="note")]
    if place.rejected:
        names = [name for name, _ in place.rejected]
        more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
        off = max(away for _, away in place.rejected)
        messages.append(
            Message(
                f"{place.source} that the images contradict, by up to {off:.0f} m, were not used: "
                f"{', '.join(names[:MAX_NAMED])}{more}"
            )
        )
    return messages
