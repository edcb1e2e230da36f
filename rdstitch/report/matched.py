"""The best and the worst pair: their matches, right and wrong."""

from html import escape
from typing import Any

import numpy as np

from rdstitch.alignment.result import LinkFit
from rdstitch.arrays import FloatArray
from rdstitch.registration import Registration
from rdstitch.report.geometry import pairs_of
from rdstitch.report.svg import GREEN, RED, drawing, element, section
from rdstitch.report.thumbnails import of_source

_WIDTH, _GAP = 440.0, 10.0
_MAX_LINES = 150
_FADED = 0.6  # opacity of the pictures, so that lines can be seen on them


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
    pair = pairs_of(registration)[fit.image1, fit.image2]
    sources = [registration.sources[k] for k in (fit.image1, fit.image2)]
    sizes = [registration.alignment.cameras[k].image_size for k in (fit.image1, fit.image2)]
    scales = [_WIDTH / width for width, _ in sizes]
    lefts = [0.0, _WIDTH + _GAP]
    parts = []
    for source, (_, height), scale, left in zip(sources, sizes, scales, lefts, strict=True):
        place: dict[str, Any] = {"x": left, "width": _WIDTH, "height": height * scale}
        picture = of_source(source, int(_WIDTH))
        parts.append(
            element("rect", fill="#ddd", **place)
            if picture is None
            else element("image", href=picture, opacity=_FADED, **place)
        )
    ends = [
        (points + 0.5) * scale + (left, 0.0)
        for points, scale, left in zip(
            (pair.correspondences.points1, pair.correspondences.points2), scales, lefts, strict=True
        )
    ]
    inliers = pair.relation.inliers
    parts += _lines(ends[0][~inliers], ends[1][~inliers], RED, 0.25)
    parts += _lines(ends[0][inliers], ends[1][inliers], GREEN, 0.6)
    tall = max(height * scale for (_, height), scale in zip(sizes, scales, strict=True))
    names = " and ".join(source.name for source in sources)
    agree = f"{fit.inliers} of {int(inliers.sum())} inliers agree with the whole, rms {fit.rms:.2f} pixels"
    text = f"{title}: {names}; {agree}"
    return element("h3", escape(text)) + drawing(2 * _WIDTH + _GAP, tall, parts, text)


def _lines(starts: FloatArray, stops: FloatArray, colour: str, opacity: float) -> list[str]:
    """Lines between points, spread evenly over the matches where there are too many."""
    chosen = np.unique(np.linspace(0, max(len(starts) - 1, 0), min(len(starts), _MAX_LINES)).astype(int))
    return [
        element(
            "line",
            x1=float(a[0]),
            y1=float(a[1]),
            x2=float(b[0]),
            y2=float(b[1]),
            stroke=colour,
            stroke_opacity=opacity,
        )
        for a, b in zip(starts[chosen], stops[chosen], strict=True)
    ]
