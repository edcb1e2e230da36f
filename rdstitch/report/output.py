"""The image that came out, with the outlines of the images in it, and what local alignment moved."""

from pathlib import Path

import numpy as np

from rdstitch.local_alignment import DisplacementField
from rdstitch.report.geometry import of_mosaic
from rdstitch.report.svg import BLUE, GREY, YELLOW, drawing, element, joined, label, line, path, section, table
from rdstitch.stitch_result import StitchResult
from rdstitch.viewer import viewer_path

_MOSAIC_SIDE = 1200
_MAX_NAMES, _MAX_RESIDUALS = 12, 20
_WIDTH, _COLUMNS, _GAP, _TEXT = 940.0, 4, 12.0, 18.0
_ARROWS = 9  # along the longer side of an image
_LONGEST = 0.8  # of the distance between arrows, for the largest displacement of all images
_MAX_IMAGES = 60


def mosaic(result: StitchResult, staged: Path | None = None) -> str:
    """The output, small; every outline has its image's name as title, and a few images have it written."""
    image = of_mosaic(result, _MOSAIC_SIDE, staged)
    if image is None:
        large = result.plan is None and result.output is not None
        return section("Mosaic", "It is too large to be shown here." if large else "No image was written.")
    name = "" if result.output is None else f"{result.output.name}, "
    width, height = result.canvas.size
    scale = _MOSAIC_SIDE / max(width, height)
    used = np.flatnonzero(result.registration.alignment.used)
    names = [result.registration.sources[index].name for index in used]
    parts = [element("image", href=image, width=width * scale, height=height * scale)]
    for text, outlines in zip(names, result.canvas.outlines, strict=True):
        places = [(outline + 0.5) * scale for outline in outlines]
        shapes = (path(place, closed=True, stroke=YELLOW, stroke_opacity=0.7, pointer_events="all") for place in places)
        parts.append(element("g", element("title", text), shapes))
        if len(names) <= _MAX_NAMES:
            x, y = min((place.mean(axis=0) for place in places), key=lambda middle: abs(middle[0] - width * scale / 2))
            style = {"fill": "white", "stroke": "black", "stroke_width": 3.0, "paint_order": "stroke"}
            parts.append(label(float(x), float(y), text, text_anchor="middle", font_size=14, **style))
    shown = drawing(width * scale, height * scale, parts, "the mosaic")
    page = None if result.output is None else viewer_path(result.output)
    more = "" if page is None else f" {page.name} beside it shows it with zoom."
    return section("Mosaic", f"{name}{width} x {height} pixels; outlines are those of the images in it.{more}", shown)


def place(result: StitchResult) -> str:
    """Where the output lies on the Earth, and the largest residuals of the positions that say so."""
    found = result.georeference
    if found is None:
        return ""
    residuals = sorted(found.residuals, key=lambda residual: -residual.off)[:_MAX_RESIDUALS]
    rows = [(r.name, f"{r.east:+.3f}", f"{r.north:+.3f}", "" if r.used else "not used") for r in residuals]
    explanation = f"{found.summary}. Where the output has them less where they were measured to be, the largest first:"
    return section("Place on the Earth", explanation, table([("", "east, m", "north, m", ""), *rows]))


def local_alignment(result: StitchResult) -> str:
    """A section with the displacement field of each image, and how much all of them mended."""
    local = result.local_alignment
    title = "Local alignment"
    if not local.fields:
        return section(title, f"Images are where the alignment puts them: {local.reason}.")
    used = np.flatnonzero(result.registration.alignment.used)
    names = [result.registration.sources[index].name for index in used]
    # The largest first: they are what one wants to look at.
    order = sorted(range(len(names)), key=lambda k: -local.fields[k].largest)[:_MAX_IMAGES]
    largest = max(max(field.largest for field in local.fields), 1e-9)
    side = (_WIDTH - (_COLUMNS - 1) * _GAP) / _COLUMNS
    row = side + _TEXT + _GAP
    corners = [(k % _COLUMNS * (side + _GAP), k // _COLUMNS * row) for k in range(len(order))]
    parts = [
        _image(local.fields[k], names[k], *corner, side, largest) for k, corner in zip(order, corners, strict=True)
    ]
    hidden = f" {len(names) - len(order)} images with smaller ones are not drawn." if len(order) < len(names) else ""
    spread = ""
    if local.before is not None and local.after is not None:
        spread = f" (95 %: {local.before.percentile95:.2f} and {local.after.percentile95:.2f} pixels)"
    return section(
        title,
        f"The ground is not quite a plane, so that each image's content is moved a little; {local.reason}{spread}. "
        f"The longest arrow of all stands for {largest:.1f} pixels.{hidden}",
        drawing(_WIDTH, -(-len(order) // _COLUMNS) * row, parts, "displacement of each image"),
    )


def _image(field: DisplacementField, name: str, x: float, y: float, side: float, largest: float) -> str:
    """One image's arrows in a square of ``side`` with its top-left corner at x, y."""
    width, height = field.image_size
    scale = side / max(width, height)
    spacing = max(width, height) / _ARROWS
    u, v = (np.arange(0.5, max(1, round(n / spacing))) * n / max(1, round(n / spacing)) for n in (width, height))
    places = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    moved = field(places)
    tips = moved * (_LONGEST * spacing / largest)
    frame = element("rect", x=x, y=y, width=width * scale, height=height * scale, fill="none", stroke=GREY)
    arrows = []
    for start, end, by in zip((x, y) + places * scale, (x, y) + (places + tips) * scale, moved, strict=True):
        title = element("title", f"{np.linalg.norm(by):.2f} pixels")
        arrows.append(line(start, end, title, stroke=BLUE, stroke_width=1.5))
        arrows.append(element("circle", cx=float(start[0]), cy=float(start[1]), r=1.2, fill=BLUE))
    return joined(frame, arrows, label(x, y + height * scale + 13.0, f"{name}: up to {field.largest:.1f} pixels"))
