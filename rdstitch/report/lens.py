"""The lens: its curve over the radius, where matches support it, and each pair's λ."""

from collections.abc import Sequence

import numpy as np

from rdstitch.alignment.lens.lens_description import describe_lens, radius_std
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.matching.distortion_consensus import Consensus, vote
from rdstitch.report.pairs import LinkResiduals
from rdstitch.report.svg import BLUE, RED, Markup, counted, drawing, element, label, line, polyline, section
from rdstitch.results.registration import Registration

_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP = 720.0, 280.0, 60.0, 40.0, 24.0
_RIGHT, _BASE = _WIDTH - 36.0, _HEIGHT - _BOTTOM
_SAMPLES = 200
_CELLS = (16, 12)  # of the image, to say how much of it has matches
_BAND = 2.0  # standard deviations on either side
_TICKS = 6
_BINS = 50  # of the histogram of votes


def _across(fractions: FloatArray, texts: list[str], title: str) -> list[Markup]:
    """Texts along the horizontal axis, at fractions of its length, and its title."""
    x = _LEFT + fractions * (_RIGHT - _LEFT)
    ticks = [label(float(at), _BASE + 16, text, text_anchor="middle") for at, text in zip(x, texts, strict=True)]
    return [*ticks, label(_WIDTH / 2, _HEIGHT - 6, title, text_anchor="middle")]


def lens_curve(registration: Registration, residuals: Sequence[LinkResiduals]) -> str:
    """Measured radii of the lens against those of the nearest one-parameter lens, with uncertainty and support."""
    alignment, camera = registration.alignment, registration.upright_camera
    farthest = float(np.linalg.norm(camera.normalize(camera.outline(1)), axis=1).max())
    return section(
        "Lens curve",
        "How many pixels farther from the distortion centre the lens measures a ray than the one-parameter lens with "
        f"λ = {alignment.distortion:.4f} (red) does, with twice the standard deviation on either side. "
        f"{_support(camera, residuals, farthest)}",
        element("ul", (element("li", text) for text in describe_lens(alignment, camera))),
        _curve(camera, np.linspace(0.0, farthest, _SAMPLES + 1)[1:]),
    )


def _support(camera: Camera, residuals: Sequence[LinkResiduals], farthest: float) -> str:
    """Where in an image of one camera's size there are matches that agree with the alignment, one sentence."""
    points = [camera.denormalize(link.camera.normalize(link.points)) for link in residuals]
    places = np.concatenate([np.empty((0, 2)), *points])
    if not len(places):
        return "No match supports it."
    across, down = _CELLS
    cell = np.clip((places + 0.5) / camera.image_size * _CELLS, 0, np.array(_CELLS) - 1).astype(int)
    seen = np.zeros((down, across), dtype=np.bool_)
    seen[cell[:, 1], cell[:, 0]] = True
    reach = float(np.quantile(np.linalg.norm(camera.normalize(places), axis=1), 0.99)) / farthest
    corners = ("top left", (0, 0)), ("top right", (0, -1)), ("bottom left", (-1, 0)), ("bottom right", (-1, -1))
    empty = [name for name, place in corners if not seen[place]]
    text = f"{len(places)} matches lie in {seen.mean():.0%} of the image, up to {reach:.0%} of the way to its corner."
    return text + (f" None lie in the corner {', '.join(empty)}: there the lens is extrapolated." if empty else "")


def _curve(camera: Camera, radii: FloatArray) -> str:
    difference, spread = camera.excess_radius(radii), _BAND * radius_std(camera, radii)
    high = max(float((np.abs(difference) + spread).max()), 0.05)
    x, middle = _LEFT + radii / radii[-1] * (_RIGHT - _LEFT), (_TOP + _BASE) / 2.0

    def at(values: FloatArray) -> FloatArray:
        return np.column_stack([x, middle - values / high * (_BASE - _TOP) / 2.0])

    band = np.concatenate([at(difference + spread), at(difference - spread)[::-1]])
    fractions = np.linspace(0.0, 1.0, _TICKS)
    parts = [
        polyline(band, closed=True, fill=BLUE, fill_opacity=0.2, stroke="none"),
        line((_LEFT, middle), (_RIGHT, middle), stroke=RED, stroke_width=1.5),
        polyline(at(difference), stroke=BLUE, stroke_width=2),
        *(
            label(_LEFT - 6, y + 4, f"{value:+.2f}" if value else "0", text_anchor="end")
            for value, y in ((high, _TOP), (0.0, middle), (-high, _BASE))
        ),
        *_across(
            fractions, [f"{r:.0f}" for r in fractions * radii[-1] * camera.scale], "pixels from the distortion centre"
        ),
        label(_LEFT, _TOP - 8, "pixels farther out than the one-parameter lens"),
    ]
    return drawing(_WIDTH, _HEIGHT, parts, "the lens against the one-parameter lens")


def votes(registration: Registration) -> str:
    """Histogram of the pairs' λ (the paper's Figure 8), each weighted by how well it sees λ, with the adjusted λ."""
    if registration.alignment.lens_given:
        return section("Votes on λ", "λ was given: no pair voted.")
    relations = [pair.relation for pair in registration.pairs if pair.relation]
    consensus = vote([r.distortion for r in relations], [r.distortion_std for r in relations])
    if not len(consensus.votes):
        where = "as where a camera hardly moves, or only turns about its axis"
        return section("Votes on λ", f"No pair voted: none of {len(relations)} can see the distortion, {where}.")
    agree = f"{int(consensus.agreeing.sum())} of them agree on {consensus.distortion:+.4f}"
    return section(
        "Votes on λ",
        f"λ of {counted(len(consensus.votes), 'pair')}, weighted by the inverse of its variance ({agree}, "
        f"scatter {consensus.scatter:.4f}). The red line is λ after the adjustment of all images.",
        _histogram(registration.alignment.distortion, consensus),
    )


def _histogram(adjusted: float, consensus: Consensus) -> str:
    values, center = consensus.votes, consensus.distortion
    span = min(values.min(), center - 1e-3), max(values.max(), center + 1e-3)
    weights, places = np.histogram(values, bins=_BINS, range=span, weights=consensus.std_of_votes**-2.0)
    weights = weights / weights.sum()
    low, high = min(places[0], adjusted), max(places[-1], adjusted)
    low, high = low - 0.02 * (high - low), high + 0.02 * (high - low)
    *edges, at = (_LEFT + (np.r_[places, adjusted] - low) / (high - low) * (_RIGHT - _LEFT)).tolist()
    heights = (weights / weights.max() * (_BASE - _TOP)).tolist()
    parts = [
        element("rect", x=left, y=_BASE - height, width=max(right - left - 0.5, 0.5), height=height, fill=BLUE)
        for left, right, height in zip(edges, edges[1:], heights, strict=False)
        if height > 0.0
    ]
    digits = max(2, int(np.ceil(-np.log10((high - low) / _TICKS))) + 1)
    parts += [
        line((_LEFT, _BASE), (_RIGHT, _BASE), stroke="black"),
        line((at, _TOP / 2), (at, _BASE), stroke=RED, stroke_width=2),
        *_across(
            np.linspace(0.0, 1.0, _TICKS),
            [f"{tick:.{digits}f}" for tick in np.linspace(low, high, _TICKS)],
            "λ (half diagonal)",
        ),
        label(_LEFT, _TOP - 8, f"weight, up to {weights.max():.0%}"),
    ]
    return drawing(_WIDTH, _HEIGHT, parts, "votes on λ")
