"""Which pictures were registered with which, over their outlines on the plane."""

from html import escape

import numpy as np

from rdstitch.registration import Registration
from rdstitch.report.geometry import footprint, middle
from rdstitch.report.svg import BLUE, GREEN, GREY, RED, counted, drawing, element, fit_into, label, path, section

_SIDE, _MARGIN = 900.0, 20.0
_LINE_HEIGHT = 11.0  # height of a name


def match_graph(registration: Registration) -> str:
    """Outlines of all pictures, and a line for each pair: thick where there are many matches, red where errors are."""
    alignment = registration.alignment
    used = np.flatnonzero(alignment.used)
    outlines = {int(k): footprint(registration, int(k)) for k in used}
    centers = {int(k): middle(registration, int(k)) for k in used}
    shift, scale, (width, height) = fit_into(np.concatenate(list(outlines.values())), _SIDE, _MARGIN)
    parts = [
        path((outline + shift) * scale, closed=True, stroke=BLUE, fill=BLUE, fill_opacity=0.05, stroke_opacity=0.5)
        for outline in outlines.values()
    ]
    links = [fit for fit in alignment.links if fit.used]
    for fit in sorted(links, key=lambda fit: fit.rms):
        (x1, y1), (x2, y2) = ((centers[k] + shift) * scale for k in (fit.image1, fit.image2))
        share = float(np.nan_to_num(np.clip(fit.rms / alignment.rms - 0.75, 0.0, 1.0)))
        names = " and ".join(registration.sources[k].name for k in (fit.image1, fit.image2))
        parts.append(
            element(
                "line",
                element("title", f"{escape(names)}: {fit.inliers} of {fit.count} matches, {fit.rms:.2f} pixels"),
                x1=float(x1),
                y1=float(y1),
                x2=float(x2),
                y2=float(y2),
                stroke=_mixed(share),
                stroke_width=float(np.clip(np.log10(fit.inliers + 1.0), 0.5, 4.0)),
            )
        )
    named: list[tuple[float, float, float]] = []  # left, baseline, width
    for index, center in centers.items():
        x, y = (center + shift) * scale
        fill = RED if index == alignment.reference else GREY
        parts.append(element("circle", cx=float(x), cy=float(y), r=4, fill=fill))
        name = registration.sources[index].name
        # A name that would lie on another one is left out; the picture's own line has it as its title.
        box = (float(x) + 6, float(y) - 6, 5.6 * len(name))
        if not any(_overlap(box, other) for other in named):
            named.append(box)
            parts.append(label(box[0], box[1], name, font_size=10))
    return section(
        "Match graph",
        f"{counted(len(links), 'pair')} over the outlines of {counted(len(used), 'picture')}. Thicker lines have more "
        "matches; green ones "
        "fit well into the whole, red ones badly. The red dot is the reference picture.",
        drawing(width, height, parts, "match graph"),
    )


def _overlap(first: tuple[float, float, float], second: tuple[float, float, float]) -> bool:
    """Whether two names (left, baseline, width) lie on one another."""
    apart = first[0] > second[0] + second[2] or second[0] > first[0] + first[2]
    return not apart and abs(first[1] - second[1]) <= _LINE_HEIGHT


def _mixed(share: float) -> str:
    """From green at 0 to red at 1."""
    low, high = ([int(colour[k : k + 2], 16) for k in (1, 3, 5)] for colour in (GREEN, RED))
    return "#" + "".join(f"{round(a + share * (b - a)):02x}" for a, b in zip(low, high, strict=True))
