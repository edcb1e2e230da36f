"""The lens as a curve over the radius, with its uncertainty, and where in the picture matches support it."""

from html import escape

import numpy as np

from rdstitch.alignment.lens_description import describe_lens, radius_std
from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.registration import Registration
from rdstitch.report.geometry import residuals
from rdstitch.report.svg import BLUE, GREY, RED, drawing, element, label, path, section

_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP = 720.0, 320.0, 60.0, 44.0, 24.0
_BARS = 40.0  # height of the drawing that the numbers of matches have
_SAMPLES = 200
_BINS = 48
_CELLS = (16, 12)  # of the picture, to say how much of it has matches
_BAND = 2.0  # standard deviations on either side


def lens_curve(registration: Registration) -> str:
    """Measured radii of the lens against those of the nearest one-parameter lens, with uncertainty and support."""
    alignment, camera = registration.alignment, registration.camera
    places = _places(registration)
    farthest = float(np.linalg.norm(camera.normalize(camera.outline(1)), axis=1).max())
    radii = np.linspace(0.0, farthest, _SAMPLES + 1)[1:]
    return section(
        "Lens curve",
        "How many pixels farther from the distortion centre the lens measures a ray than the one-parameter lens with "
        f"λ = {alignment.distortion:.4f} (red) does, with twice the standard deviation on either side; below it, how "
        f"many matches there are at each radius. {_support(camera, places, farthest)}",
        element("ul", "".join(element("li", escape(line)) for line in describe_lens(alignment))),
        _drawing(camera, radii, _counts(camera, places, farthest)),
    )


def _places(registration: Registration) -> FloatArray:
    """Where the matches that agree with the alignment are, pixels of pictures of the reference's size, (N, 2)."""
    alignment, camera = registration.alignment, registration.camera
    found = [np.empty((0, 2))]
    for fit in alignment.links:
        if fit.used and fit.rms > 0.0:
            other = alignment.cameras[fit.image2]
            own = other.normalize(residuals(registration, fit)[0])
            found.append(camera.denormalize(own))
    return np.concatenate(found)


def _counts(camera: Camera, places: FloatArray, farthest: float) -> FloatArray:
    """Share of the matches at each of the radii of the bars, relative to the fullest bar."""
    radius = np.linalg.norm(camera.normalize(places), axis=1)
    counts = np.histogram(radius, bins=_BINS, range=(0.0, farthest))[0]
    return np.asarray(counts / max(int(counts.max()), 1), dtype=np.float64)


def _support(camera: Camera, places: FloatArray, farthest: float) -> str:
    """Where in the picture there are matches, one sentence."""
    if not len(places):
        return "No match supports it."
    across, down = _CELLS
    cell = np.clip((places + 0.5) / camera.image_size * _CELLS, 0, np.array(_CELLS) - 1).astype(int)
    seen = np.zeros((down, across), dtype=np.bool_)
    seen[cell[:, 1], cell[:, 0]] = True
    reach = float(np.quantile(np.linalg.norm(camera.normalize(places), axis=1), 0.99)) / farthest
    corners = ("top left", (0, 0)), ("top right", (0, -1)), ("bottom left", (-1, 0)), ("bottom right", (-1, -1))
    bare = [name for name, place in corners if not seen[place]]
    text = f"{len(places)} matches lie in {seen.mean():.0%} of the picture, up to {reach:.0%} of the way to its corner."
    return text + (f" None lie in the corner {', '.join(bare)}: there the lens is extrapolated." if bare else "")


def _drawing(camera: Camera, radii: FloatArray, counts: FloatArray) -> str:
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
        parts.append(
            label(x, _HEIGHT - _BOTTOM + 16, f"{share * radii[-1] * camera.half_diagonal:.0f}", text_anchor="middle")
        )
    parts.append(label(_WIDTH / 2, _HEIGHT - 8, "pixels from the distortion centre", text_anchor="middle"))
    parts.append(label(_LEFT, _TOP - 8, "pixels farther out than the one-parameter lens"))
    return drawing(_WIDTH, _HEIGHT, parts, "the lens against the one-parameter lens")
