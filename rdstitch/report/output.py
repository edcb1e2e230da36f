"""The image that came out, with the outlines of the images in it, its place, and what local alignment moved."""

from pathlib import Path

import numpy as np

from rdstitch.alignment.trajectory import Trajectory
from rdstitch.compositing.panorama_canvas import seen_directions
from rdstitch.export.trajectory_files import path_as_svg
from rdstitch.registration import Registration
from rdstitch.report.geometry import of_mosaic
from rdstitch.report.svg import YELLOW, Markup, drawing, element, label, path, section, table
from rdstitch.stitch_result import StitchResult
from rdstitch.viewer import viewer_path

_MOSAIC_SIDE = 1200
_MAX_NAMES, _MAX_ROWS = 12, 20


def mosaic(result: StitchResult, staged: Path | None = None) -> str:
    """The output, small; every outline has its image's name as title, and a few images have it written."""
    image = of_mosaic(result, _MOSAIC_SIDE, staged)
    if image is None:
        large = result.plan is None and result.output is not None
        return section("Mosaic", "It is too large to be shown here." if large else "No image was written.")
    name = "" if result.output is None else f"{result.output.name}, "
    width, height = result.canvas.size
    scale = _MOSAIC_SIDE / max(width, height)
    names = result.registration.used_names
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
    residuals = sorted(found.residuals, key=lambda residual: -residual.off)[:_MAX_ROWS]
    rows = [(r.name, f"{r.east:+.3f}", f"{r.north:+.3f}", "" if r.used else "not used") for r in residuals]
    explanation = f"{found.summary}. Where the output has them less where they were measured to be, the largest first:"
    return section("Place on the Earth", explanation, table([("", "east, m", "north, m", ""), *rows]))


def local_alignment(result: StitchResult) -> str:
    """How much local alignment mended, and the images that it moved farthest."""
    local = result.local_alignment
    if not local.fields:
        return section("Local alignment", f"Images are where the alignment puts them: {local.reason}.")
    spread = ""
    if local.before is not None and local.after is not None:
        spread = f" (95 %: {local.before.percentile95:.2f} and {local.after.percentile95:.2f} pixels)"
    moved = zip(result.registration.used_names, local.fields, strict=True)
    farthest = sorted(moved, key=lambda image: -image[1].largest)[:_MAX_ROWS]
    return section(
        "Local alignment",
        f"The ground is not quite a plane, so that each image's content is moved a little; {local.reason}{spread}.",
        table((name, f"up to {field.largest:.1f} pixels") for name, field in farthest),
    )


def trajectory(registration: Registration) -> str:
    """The path of the camera over the plane, where the model has metric poses; how far it looked, if it only turned."""
    alignment = registration.alignment
    if alignment.on_sphere:
        used = np.flatnonzero(alignment.used).tolist()
        view = seen_directions([alignment.cameras[k] for k in used], alignment.homographies[used])
        across, down = np.degrees(view.extent)
        focal = registration.camera.focal
        return section(
            "Directions",
            f"The camera turned on the spot. Its {len(used)} images show {across:.0f} x {down:.0f} degrees around it."
            + ("" if focal is None else f" The focal length is {focal:.1f} pixels."),
        )
    if alignment.poses is None:
        return section("Trajectory", "The general model has a homography for each image, but no poses.")
    trail = Trajectory.from_alignment(alignment)
    length = float(np.linalg.norm(np.diff(trail.position, axis=0), axis=1).sum())
    return section(
        "Trajectory",
        f"{len(trail)} positions in the order of the images, {length:.2f} heights of the first one long; the green "
        "dot is the first, arrows point to the upper side of the image.",
        Markup(path_as_svg(trail)),
    )
