"""The pairs: over the outlines of the images, the best and the worst one, and what the model leaves over."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rdstitch.alignment.result import LinkFit
from rdstitch.arrays import FloatArray, evenly_spaced
from rdstitch.compositing.projection import PROJECTIONS
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import to_directions, to_plane
from rdstitch.report.svg import (
    BLUE,
    GREEN,
    GREY,
    RED,
    Markup,
    counted,
    drawing,
    element,
    joined,
    label,
    line,
    of_source,
    polyline,
    section,
)
from rdstitch.results.registration import Registration

_POINTS_PER_SIDE = 16
_GRAPH_SIDE, _GRAPH_MARGIN = 900.0, 20.0
_MAX_NAMES = 12  # images whose names are written
_IMAGE_WIDTH, _IMAGE_GAP = 440.0, 10.0
_MAX_LINES = 150
_MAX_LINKS = 2000  # lines of the match graph
_FADED = 0.6  # opacity of the images, so that lines can be seen on them
_MAP_WIDTH, _COLUMNS = 640.0, 16
_MIN_MATCHES = 4  # matches in a cell that make a mean
_ARROW = 0.9  # of a cell's width, for the largest mean


class LinkResiduals(NamedTuple):
    """How well the inliers of a link agree with the alignment."""

    camera: Camera  # of its second image
    points: FloatArray  # (N, 2): where they are in that, pixels
    errors: FloatArray  # (N, 2): how far the alignment puts them from there, pixels


def match_graph(registration: Registration) -> str:
    """Outlines of all images, and a line for each pair: thick where there are many matches, red where errors are."""
    alignment = registration.alignment
    used = np.flatnonzero(alignment.used).tolist()
    outlines, placed = zip(*(_outline_and_center(registration, k) for k in used), strict=True)
    centers, points = dict(zip(used, placed, strict=True)), np.concatenate(outlines)
    low = np.nanmin(points, axis=0)
    extent = np.maximum(np.nanmax(points, axis=0) - low, 1e-9)
    scale = float((_GRAPH_SIDE - 2 * _GRAPH_MARGIN) / extent.max())
    (width, height), shift = (extent * scale + 2 * _GRAPH_MARGIN).tolist(), _GRAPH_MARGIN / scale - low
    parts = [
        polyline((outline + shift) * scale, closed=True, stroke=BLUE, fill=BLUE, fill_opacity=0.05, stroke_opacity=0.5)
        for outline in outlines
    ]
    links = alignment.holding
    by_error = sorted(links, key=lambda fit: fit.rms)
    for fit in (by_error[k] for k in evenly_spaced(len(links), _MAX_LINKS)):
        excess = float(np.nan_to_num(np.clip(fit.rms / alignment.rms - 0.75, 0.0, 1.0)))
        names = " and ".join(registration.sources[k].name for k in fit.images)
        title = element("title", f"{names}: {fit.inliers} of {fit.count} matches, {fit.rms:.2f} pixels")
        start, end = ((centers[k] + shift) * scale for k in fit.images)
        thickness = float(np.clip(np.log10(fit.inliers + 1.0), 0.5, 4.0))
        parts.append(line(start, end, title, stroke=_mixed(excess), stroke_width=thickness))
    for index, center in centers.items():
        x, y = ((center + shift) * scale).tolist()
        name, fill = registration.sources[index].name, RED if index == alignment.reference else GREY
        parts.append(element("circle", element("title", name), cx=x, cy=y, r=4, fill=fill))
        if len(used) <= _MAX_NAMES:
            parts.append(label(x + 6, y - 6, name, font_size=10))
    omitted = f", of which {_MAX_LINKS} of all errors are drawn," if len(links) > _MAX_LINKS else ""
    return section(
        "Match graph",
        f"{counted(len(links), 'pair')}{omitted} over the outlines of {counted(len(used), 'image')}. Thicker lines "
        "have more matches; green ones fit the result well, red ones badly. The red dot is the reference image.",
        drawing(width, height, parts, "match graph"),
    )


def _mixed(fraction: float) -> str:
    """From green at 0 to red at 1."""
    low, high = ([int(colour[k : k + 2], 16) for k in (1, 3, 5)] for colour in (GREEN, RED))
    return "#" + "".join(f"{round(a + fraction * (b - a)):02x}" for a, b in zip(low, high, strict=True))


def matched(registration: Registration) -> str:
    """The used pairs with the smallest and the largest error; the best one is among those with many matches."""
    links = sorted((fit for fit in registration.alignment.links if fit.used), key=lambda fit: fit.rms)
    if not links:
        return section("Matches", "No pair was used.")
    # A few matches fit anything.
    usual = np.median([fit.inliers for fit in links])
    best = next(fit for fit in links if fit.inliers >= usual)
    others = [fit for fit in links if fit is not best]
    shown = {"Best pair": best, "Worst pair": others[-1]} if others else {"The pair": best}
    return section(
        "Matches",
        f"Inliers are green, matches that were taken for wrong red; at most {_MAX_LINES} of each are drawn.",
        *(_pair(registration, title, fit) for title, fit in shown.items()),
    )


def _pair(registration: Registration, title: str, fit: LinkFit) -> str:
    pair = next(pair for pair in registration.pairs if pair.images == fit.images)
    sources = [registration.sources[k] for k in fit.images]
    sizes = [registration.alignment.cameras[k].image_size for k in fit.images]
    scales = [_IMAGE_WIDTH / width for width, _ in sizes]
    lefts = [0.0, _IMAGE_WIDTH + _IMAGE_GAP]
    parts = []
    for source, (_, height), scale, left in zip(sources, sizes, scales, lefts, strict=True):
        place: dict[str, Any] = {"x": left, "width": _IMAGE_WIDTH, "height": height * scale}
        image = of_source(source, int(_IMAGE_WIDTH))
        parts.append(
            element("rect", fill="#ddd", **place)
            if image is None
            else element("image", href=image, opacity=_FADED, **place)
        )
    matched = pair.correspondences
    points = zip((matched.points1, matched.points2), scales, lefts, strict=True)
    ends = [(measured + 0.5) * scale + (left, 0.0) for measured, scale, left in points]
    inliers = pair.relation.inliers
    parts += _match_lines(ends[0][~inliers], ends[1][~inliers], RED, 0.25)
    parts += _match_lines(ends[0][inliers], ends[1][inliers], GREEN, 0.6)
    drawn_height = max(height * scale for (_, height), scale in zip(sizes, scales, strict=True))
    names = " and ".join(source.name for source in sources)
    agree = f"{fit.inliers} of {int(inliers.sum())} inliers fit the result, rms {fit.rms:.2f} pixels"
    text = f"{title}: {names}; {agree}"
    return joined(element("h3", text), drawing(2 * _IMAGE_WIDTH + _IMAGE_GAP, drawn_height, parts, text))


def _match_lines(starts: FloatArray, stops: FloatArray, colour: str, opacity: float) -> list[Markup]:
    """Lines between points, spread evenly over the matches where there are too many."""
    chosen = evenly_spaced(len(starts), _MAX_LINES)
    ends = zip(starts[chosen], stops[chosen], strict=True)
    return [line(start, stop, stroke=colour, stroke_opacity=opacity) for start, stop in ends]


def residual_map(registration: Registration, residuals: Sequence[LinkResiduals]) -> str:
    """Errors of all pairs over the area of the image: rms as grey, mean as an arrow."""
    if not residuals:
        return section("Residuals", "There are none.")
    # Images of several sizes are laid over one another.
    places = np.concatenate([(link.points + 0.5) / link.camera.image_size for link in residuals])
    error = np.concatenate([link.errors for link in residuals])
    width, height = registration.upright_camera.image_size
    rows = max(1, round(_COLUMNS * height / width))
    cell = np.clip((places * (_COLUMNS, rows)).astype(int), 0, (_COLUMNS - 1, rows - 1)) @ (1, _COLUMNS)
    cells = _COLUMNS * rows
    count = np.bincount(cell, minlength=cells)
    mean = np.stack([np.bincount(cell, error[:, k], cells) for k in (0, 1)], axis=1) / np.maximum(count, 1)[:, None]
    rms = np.sqrt(np.bincount(cell, (error**2).sum(axis=1), cells) / np.maximum(count, 1))
    enough = count >= _MIN_MATCHES
    if not enough.any():
        return section("Residuals", f"There are too few matches ({len(error)}) to draw them over the image.")
    side, darkest = _MAP_WIDTH / _COLUMNS, float(rms[enough].max())
    longest = max(float(np.linalg.norm(mean[enough], axis=1).max()), 1e-9)
    parts = [
        Markup(
            '<defs><marker id="residual" markerWidth="5" markerHeight="5" refX="3" refY="2.5" orient="auto">'
            f'<path d="M0,0 L5,2.5 L0,5 z" fill="{RED}"/></marker></defs>'
        )
    ]
    for index in np.flatnonzero(enough):
        y, x = divmod(int(index), _COLUMNS)
        shade = 255 - round(150 * rms[index] / max(darkest, 1e-9))
        tip = mean[index] / longest * _ARROW * side
        title = f"{count[index]} matches, rms {rms[index]:.2f} pixels, mean {np.linalg.norm(mean[index]):.2f} pixels"
        box = {"x": x * side, "y": y * side, "width": side, "height": side}
        parts.append(element("rect", element("title", title), fill=f"rgb({shade},{shade},{shade})", **box))
        start = np.array([(x + 0.5) * side, (y + 0.5) * side])
        ends = start - tip / 2, start + tip / 2
        parts.append(line(*ends, stroke=RED, stroke_width=1.5, marker_end="url(#residual)"))
    map_height = rows * side
    text = f"darkest cell: rms {darkest:.2f} pixels; longest arrow: mean of {longest:.2f} pixels in that direction"
    parts.append(label(0.0, map_height + 16, text))
    return section(
        "Residuals",
        f"{len(error)} inliers of all pairs over the area of the image. Arrows that follow a pattern show something "
        "that the model does not describe: relief, a rolling shutter, a lens that one λ is not enough for.",
        drawing(_MAP_WIDTH, map_height + 22, parts, "residuals over the image"),
    )


def link_residuals(registration: Registration) -> list[LinkResiduals]:
    """Of each link that is used; without the inliers that miss by more than four times its error."""
    alignment, pairs = registration.alignment, {pair.images: pair for pair in registration.pairs}
    residuals = []
    for fit in alignment.links:
        if fit.used and fit.rms > 0.0:
            link = pairs[fit.images].link()
            errors = alignment.transfer(*fit.images, link.points1) - link.points2
            kept = np.linalg.norm(errors, axis=1) <= 4.0 * fit.rms
            residuals.append(LinkResiduals(alignment.cameras[fit.image2], link.points2[kept], errors[kept]))
    return residuals


def _outline_and_center(registration: Registration, index: int) -> tuple[FloatArray, FloatArray]:
    """Of an image (K, 2) and (2,), on the plane; where the camera only turned, longitude and latitude, radians."""
    camera, matrix = registration.alignment.cameras[index], registration.alignment.homographies[index]
    points = np.concatenate([camera.outline(_POINTS_PER_SIDE), [camera.image_center]])
    if registration.alignment.on_sphere:
        places = PROJECTIONS["sphere"].project(to_directions(camera, matrix, points))
        # Longitudes of one image have no jump.
        middle = np.arctan2(matrix[0, 2], matrix[2, 2])
        places[:, 0] = middle + np.mod(places[:, 0] - middle + np.pi, 2.0 * np.pi) - np.pi
    else:
        places = to_plane(camera, matrix, points)
    return places[:-1], places[-1]
