"""The output, small, with the outlines of its images and the places along its seams."""

import math
from pathlib import Path

import numpy as np

from rdstitch.compositing.seam_quality import SeamQuality
from rdstitch.errors import InputError
from rdstitch.io.preview import read_preview
from rdstitch.report.svg import GREEN, RED, YELLOW, counted, data_address, drawing, element, label, polyline, section
from rdstitch.results.stitch_result import StitchResult
from rdstitch.viewer.page import viewer_path

_MOSAIC_SIDE = 1200  # pixels of the longer side
_MAX_NAMES, _MAX_BREAKS, _MAX_DOTS = 12, 20, 5000
_OUTLINED = {"stroke_width": 3.0, "paint_order": "stroke"}


def mosaic_section(result: StitchResult, file: Path | None) -> str:
    """The output, small; every outline has its image's name as title, and a few images have it written."""
    image = _thumbnail(result, file)
    if image is None:
        if result.plan is not None or result.output is None:
            return section("Mosaic", "No image was written.")
        tiled = result.output.suffix.lower() in (".dzi", ".zarr")
        reason = "a folder of tiles, which is not" if tiled else "too large to be"
        return section("Mosaic", f"It is {reason} shown here.")
    name = "" if result.output is None else f"{result.output.name}, "
    width, height = result.canvas.size
    scale = _MOSAIC_SIDE / max(width, height)
    names = result.registration.used_names
    parts = [element("image", href=image, width=width * scale, height=height * scale)]
    for text, borders in zip(names, result.canvas.outlines, strict=True):
        places = [(border + 0.5) * scale for border in borders]
        shapes = (
            polyline(place, closed=True, stroke=YELLOW, stroke_opacity=0.7, pointer_events="all") for place in places
        )
        parts.append(element("g", element("title", text), shapes))
        if len(names) <= _MAX_NAMES:
            x, y = min((place.mean(axis=0) for place in places), key=lambda middle: abs(middle[0] - width * scale / 2))
            style = {"fill": "white", "stroke": "black", "text_anchor": "middle", "font_size": 14}
            parts.append(label(float(x), float(y), text, **style, **_OUTLINED))
    seams, radius = result.seams, max(0.35 * result.seams.spacing * scale, 1.5)
    for x, y, broken in seam_dots(seams, scale, max(2.0 * radius, scale * math.sqrt(width * height / _MAX_DOTS))):
        parts.append(element("circle", cx=x, cy=y, r=radius, fill=RED if broken else GREEN))
    for one in seams.breaks[:_MAX_BREAKS]:
        x, y = ((value + 0.5) * scale for value in one.position)
        parts.append(label(x + 8.0, y, f"{one.length:.0f} px", fill=RED, font_size=14, stroke="white", **_OUTLINED))
    shown = drawing(width * scale, height * scale, parts, "the mosaic")
    page = None if result.output is None else viewer_path(result.output)
    more = "" if page is None else f" {page.name} beside it shows it with zoom."
    text = f"{name}{width} x {height} pixels; outlines are those of the images in it, dots the places along the seams "
    text += f"that have texture on both sides: green where the seam holds, red where it is broken.{more}"
    return section("Mosaic", text, _broken_seams(result), shown)


def seam_dots(seams: SeamQuality, scale: float, spacing: float) -> list[tuple[float, float, bool]]:
    """Places along seams, pixels of a drawing, and whether broken: one in each cell of side ``spacing``."""
    at = (seams.places + 0.5) * scale
    order = np.argsort(~seams.broken, kind="stable")
    _, first = np.unique((at[order] // spacing).astype(np.int64), axis=0, return_index=True)
    return [(float(at[k, 0]), float(at[k, 1]), bool(seams.broken[k])) for k in np.sort(order[first])]


def _broken_seams(result: StitchResult) -> str:
    seams = result.seams
    if not len(seams.places):
        return ""
    text = f"{counted(int(seams.broken.sum()), 'place')} of {len(seams.places)} along the seams broken."
    return element("p", text, class_="bad" if seams.broken_in_output else "good")


def _thumbnail(result: StitchResult, file: Path | None) -> str | None:
    """The output, or the file where it lies now, small; None where there is none, as after a dry run, or it is huge."""
    if result.composite is not None:
        return data_address(result.composite.pixels, _MOSAIC_SIDE)
    if file is None or not file.exists():
        return None
    try:
        return data_address(read_preview(file, result.canvas.size, _MOSAIC_SIDE)[0], _MOSAIC_SIDE)
    except InputError:
        return None
