"""The picture that came out, with the outlines of the pictures in it."""

from html import escape
from pathlib import Path

import numpy as np

from rdstitch.report.svg import YELLOW, drawing, element, label, path, section
from rdstitch.report.thumbnails import of_mosaic
from rdstitch.stitch_result import StitchResult
from rdstitch.viewer import viewer_path

_SIDE = 1200
_MAX_NAMES = 12


def mosaic(result: StitchResult, staged: Path | None = None) -> str:
    """The output, small; every outline has its picture's name as title, and a few pictures have it written."""
    picture = of_mosaic(result, _SIDE, staged)
    if picture is None:
        return section("Mosaic", "No picture was written.")
    name = "" if result.output is None else f"{result.output.name}, "
    width, height = result.canvas.size
    scale = _SIDE / max(width, height)
    used = np.flatnonzero(result.registration.alignment.used)
    names = [result.registration.sources[index].name for index in used]
    parts = [element("image", href=picture, width=width * scale, height=height * scale)]
    for text, outlines in zip(names, result.canvas.outlines, strict=True):
        places = [(outline + 0.5) * scale for outline in outlines]
        shapes = (path(place, closed=True, stroke=YELLOW, stroke_opacity=0.7, pointer_events="all") for place in places)
        parts.append(element("g", element("title", escape(text)) + "".join(shapes)))
        if len(names) <= _MAX_NAMES:
            x, y = min((place.mean(axis=0) for place in places), key=lambda middle: abs(middle[0] - width * scale / 2))
            style = {"fill": "white", "stroke": "black", "stroke_width": 3.0, "paint_order": "stroke"}
            parts.append(label(float(x), float(y), text, text_anchor="middle", font_size=14, **style))
    shown = drawing(width * scale, height * scale, parts, "the mosaic")
    page = None if result.output is None else viewer_path(result.output)
    more = "" if page is None else f" {page.name} beside it shows it with zoom."
    return section("Mosaic", f"{name}{width} x {height} pixels; outlines are those of the pictures in it.{more}", shown)
