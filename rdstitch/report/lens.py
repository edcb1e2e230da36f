"""The lens: what it does to a grid, its curve over the radius with the matches that support it, and each pair's λ."""

import math

import numpy as np
from numpy.typing import NDArray

from rdstitch.alignment.lens_description import describe_lens, radius_std
from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.matching.distortion_consensus import Consensus, vote
from rdstitch.registration import Registration
from rdstitch.report.geometry import of_source, residuals
from rdstitch.report.svg import BLUE, GREY, RED, YELLOW, counted, drawing, element, fit_into, label, path, section

_GRID_LINES, _POINTS_OF_LINE = 13, 49
_GRID_WIDTH = 430.0
_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP = 720.0, 320.0, 60.0, 44.0, 24.0
_BARS = 40.0  # height of the drawing that the numbers of matches have
_SAMPLES = 200
_BINS = 48
_CELLS = (16, 12)  # of the image, to say how much of it has matches
_BAND = 2.0  # standard deviations on either side
_VOTES_HEIGHT, _VOTES_LEFT, _VOTES_BOTTOM, _VOTES_TOP = 280.0, 50.0, 40.0, 20.0
_TICKS = 6


def grid(registration: Registration) -> str:
    """Straight lines as the lens bends them, and the image's rows and columns as undistortion straightens them."""
    camera = registration.upright_camera
    reference = registration.sources[registration.alignment.reference]
    return section(
        "Lens",
        f"Left: {reference.name}, and straight lines of the scene as the lens bends them. Right: rows and columns of "
        "the image after undistortion; the red frame is the image before.",
        element("div", _before(camera, of_source(reference, int(_GRID_WIDTH))), _after(camera), class_="beside"),
    )


def _lines(low: FloatArray, high: FloatArray) -> list[FloatArray]:
    """Rows and columns between two corners, densely sampled."""
    across = [np.linspace(low[k], high[k], _GRID_LINES) for k in (0, 1)]
    along = [np.linspace(low[k], high[k], _POINTS_OF_LINE) for k in (0, 1)]
    columns = [np.column_stack([np.full(_POINTS_OF_LINE, x), along[1]]) for x in across[0]]
    return columns + [np.column_stack([along[0], np.full(_POINTS_OF_LINE, y)]) for y in across[1]]


def _before(camera: Camera, image: str | None) -> str:
    width, height = camera.image_size
    scale = _GRID_WIDTH / width
    outline = camera.undistort(camera.outline(16))
    bent = [camera.distort(line) for line in _lines(outline.min(axis=0), outline.max(axis=0))]
    shown = [np.where(_inside(line, camera)[:, None], line, np.nan) for line in bent]
    back = "" if image is None else element("image", href=image, width=_GRID_WIDTH, height=height * scale)
    parts = [back, *(path((line + 0.5) * scale, stroke=YELLOW, stroke_width=1.4) for line in shown)]
    return drawing(_GRID_WIDTH, height * scale, parts, "a grid of straight lines as measured")


def _inside(points: FloatArray, camera: Camera) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        within = (points >= -0.5) & (points <= np.array(camera.image_size) - 0.5)
    return within[:, 0] & within[:, 1]


def _after(camera: Camera) -> str:
    width, height = camera.image_size
    corner = np.array([width - 0.5, height - 0.5])
    frame = camera.outline(1)
    straight = [camera.undistort(line) for line in _lines(np.array([-0.5, -0.5]), corner)]
    shift, scale, (wide, high) = fit_into(np.concatenate([*straight, frame]), _GRID_WIDTH, 6.0)
    parts = [path((line + shift) * scale, stroke=BLUE) for line in straight]
    parts.append(path((frame + shift) * scale, closed=True, stroke=RED, stroke_width=1.5))
    return drawing(wide, high, parts, "rows and columns after undistortion")


def lens_curve(registration: Registration) -> str:
    """Measured radii of the lens against those of the nearest one-parameter lens, with uncertainty and support."""
    alignment, camera = registration.alignment, registration.upright_camera
    places = _places(registration)
    farthest = float(np.linalg.norm(camera.normalize(camera.outline(1)), axis=1).max())
    radii = np.linspace(0.0, farthest, _SAMPLES + 1)[1:]
    counts = np.histogram(np.linalg.norm(camera.normalize(places), axis=1), bins=_BINS, range=(0.0, farthest))[0]
    return section(
        "Lens curve",
        "How many pixels farther from the distortion centre the lens measures a ray than the one-parameter lens with "
        f"λ = {alignment.distortion:.4f} (red) does, with twice the standard deviation on either side; below it, how "
        f"many matches there are at each radius. {_support(camera, places, farthest)}",
        element("ul", (element("li", line) for line in describe_lens(alignment, camera))),
        _curve(camera, radii, np.asarray(counts / max(int(counts.max()), 1), dtype=np.float64)),
    )


def _places(registration: Registration) -> FloatArray:
    """Where the matches that agree with the alignment are, pixels of images of the reference's size, (N, 2)."""
    alignment, camera = registration.alignment, registration.upright_camera
    found = [np.empty((0, 2))]
    for fit in alignment.links:
        if fit.used and fit.rms > 0.0:
            other = alignment.cameras[fit.image2]
            own = other.normalize(residuals(registration, fit)[0])
            found.append(camera.denormalize(own))
    return np.concatenate(found)


def _support(camera: Camera, places: FloatArray, farthest: float) -> str:
    """Where in the image there are matches, one sentence."""
    if not len(places):
        return "No match supports it."
    across, down = _CELLS
    cell = np.clip((places + 0.5) / camera.image_size * _CELLS, 0, np.array(_CELLS) - 1).astype(int)
    seen = np.zeros((down, across), dtype=np.bool_)
    seen[cell[:, 1], cell[:, 0]] = True
    reach = float(np.quantile(np.linalg.norm(camera.normalize(places), axis=1), 0.99)) / farthest
    corners = ("top left", (0, 0)), ("top right", (0, -1)), ("bottom left", (-1, 0)), ("bottom right", (-1, -1))
    bare = [name for name, place in corners if not seen[place]]
    text = f"{len(places)} matches lie in {seen.mean():.0%} of the image, up to {reach:.0%} of the way to its corner."
    return text + (f" None lie in the corner {', '.join(bare)}: there the lens is extrapolated." if bare else "")


def _curve(camera: Camera, radii: FloatArray, counts: FloatArray) -> str:
    difference, spread = camera.excess_radius(radii), _BAND * radius_std(camera, radii)
    base, right = _HEIGHT - _BOTTOM - _BARS, _WIDTH - 20.0
    high = max(float((np.abs(difference) + spread).max()), 0.05)

    def at(values: FloatArray) -> FloatArray:
        x = _LEFT + radii / radii[-1] * (right - _LEFT)
        y = (_TOP + base) / 2.0 - values / high * (base - _TOP) / 2.0
        return np.column_stack([x, y])

    band = np.concatenate([at(difference + spread), at(difference - spread)[::-1]])
    zero = float(at(np.zeros_like(radii))[0, 1])
    wide = (right - _LEFT) / len(counts)
    parts = [path(band, closed=True, fill=BLUE, fill_opacity=0.2, stroke="none")]
    parts.append(element("line", x1=_LEFT, x2=right, y1=zero, y2=zero, stroke=RED, stroke_width=1.5))
    parts.append(path(at(difference), stroke=BLUE, stroke_width=2))
    parts += [
        element(
            "rect",
            x=float(_LEFT + index * wide),
            y=float(_HEIGHT - _BOTTOM - share * (_BARS - 6.0)),
            width=wide - 1.0,
            height=float(share * (_BARS - 6.0)),
            fill=GREY,
        )
        for index, share in enumerate(counts)
        if share > 0.0
    ]
    for value, y in ((high, _TOP), (0.0, zero), (-high, base)):
        parts.append(label(_LEFT - 6, y + 4, f"{value:+.2f}" if value else "0", text_anchor="end"))
    for share in np.linspace(0.0, 1.0, 6):
        x = float(_LEFT + share * (right - _LEFT))
        parts.append(label(x, _HEIGHT - _BOTTOM + 16, f"{share * radii[-1] * camera.scale:.0f}", text_anchor="middle"))
    parts.append(label(_WIDTH / 2, _HEIGHT - 8, "pixels from the distortion centre", text_anchor="middle"))
    parts.append(label(_LEFT, _TOP - 8, "pixels farther out than the one-parameter lens"))
    return drawing(_WIDTH, _HEIGHT, parts, "the lens against the one-parameter lens")


def votes(registration: Registration) -> str:
    """Histogram of the pairs' λ (the paper's Figure 8), each weighted by how well it sees λ, with the adjusted λ."""
    if registration.alignment.distortion_std == 0.0:
        return section("Votes on λ", "λ was given: no pair voted.")
    relations = [pair.relation for pair in registration.pairs if pair.relation]
    consensus = vote([r.distortion for r in relations], [r.distortion_std for r in relations])
    if consensus.votes == 0:
        return section("Votes on λ", f"No pair voted: {consensus.reason}.")
    return section(
        "Votes on λ",
        f"λ of {counted(consensus.votes, 'pair')}, weighted by the inverse of its variance ({consensus.reason}, "
        f"scatter {consensus.scatter:.4f}). The red line is λ after the adjustment of all images, grey ticks "
        "single pairs.",
        _histogram(registration, consensus, [r.distortion for r in relations if math.isfinite(r.distortion_std)]),
    )


def _histogram(registration: Registration, consensus: Consensus, values: list[float]) -> str:
    adjusted = registration.alignment.distortion
    low, high = min(consensus.edges[0], adjusted), max(consensus.edges[-1], adjusted)
    low, high = low - 0.02 * (high - low), high + 0.02 * (high - low)
    base = _VOTES_HEIGHT - _VOTES_BOTTOM
    tall = (base - _VOTES_TOP) / consensus.histogram.max()

    def x_of(value: float) -> float:
        return float(_VOTES_LEFT + (value - low) / (high - low) * (_WIDTH - _VOTES_LEFT - 20.0))

    parts = [
        element(
            "rect",
            x=x_of(left),
            y=float(base - weight * tall),
            width=max(x_of(right) - x_of(left) - 0.5, 0.5),
            height=float(weight * tall),
            fill=BLUE,
        )
        for left, right, weight in zip(consensus.edges, consensus.edges[1:], consensus.histogram, strict=False)
        if weight > 0.0
    ]
    parts += [element("line", x1=x_of(v), x2=x_of(v), y1=base, y2=base + 6, stroke=GREY) for v in values]
    parts.append(element("line", x1=_VOTES_LEFT, x2=_WIDTH - 20.0, y1=base, y2=base, stroke="black"))
    parts.append(
        element("line", x1=x_of(adjusted), x2=x_of(adjusted), y1=_VOTES_TOP / 2, y2=base, stroke=RED, stroke_width=2)
    )
    digits = max(2, math.ceil(-math.log10((high - low) / _TICKS)) + 1)
    parts += [
        label(x_of(tick), base + 22, f"{tick:.{digits}f}", text_anchor="middle")
        for tick in np.linspace(low, high, _TICKS)
    ]
    parts.append(label(_VOTES_LEFT, _VOTES_TOP - 6, f"weight, up to {consensus.histogram.max():.0%}"))
    parts.append(label(_WIDTH / 2, _VOTES_HEIGHT - 4, "λ (half diagonal)", text_anchor="middle"))
    return drawing(_WIDTH, _VOTES_HEIGHT, parts, "votes on λ")
