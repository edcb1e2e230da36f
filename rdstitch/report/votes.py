"""What each pair says of λ: the weighted histogram of the paper's Figure 8."""

import math

import numpy as np

from rdstitch.matching.distortion_consensus import Consensus, vote
from rdstitch.registration import Registration
from rdstitch.report.svg import BLUE, GREY, RED, counted, drawing, element, label, section

_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP = 720.0, 280.0, 50.0, 40.0, 20.0
_TICKS = 6


def votes(registration: Registration) -> str:
    """The histogram of the pairs' λ, each pair weighted by how well it can see λ, with the adjusted λ."""
    if registration.alignment.distortion_std == 0.0:
        return section("Votes on λ", "λ was given: no pair voted.")
    relations = [pair.relation for pair in registration.pairs if pair.relation]
    consensus = vote([r.distortion for r in relations], [r.distortion_std for r in relations])
    if consensus.votes == 0:
        return section("Votes on λ", f"No pair voted: {consensus.reason}.")
    return section(
        "Votes on λ",
        f"λ of {counted(consensus.votes, 'pair')}, weighted by the inverse of its variance ({consensus.reason}, "
        f"scatter {consensus.scatter:.4f}). The red line is λ after the adjustment of all pictures, grey ticks "
        "single pairs.",
        _histogram(registration, consensus, [r.distortion for r in relations if math.isfinite(r.distortion_std)]),
    )


def _histogram(registration: Registration, consensus: Consensus, values: list[float]) -> str:
    adjusted = registration.alignment.distortion
    low, high = min(consensus.edges[0], adjusted), max(consensus.edges[-1], adjusted)
    low, high = low - 0.02 * (high - low), high + 0.02 * (high - low)
    base = _HEIGHT - _BOTTOM
    tall = (base - _TOP) / consensus.histogram.max()

    def x_of(value: float) -> float:
        return float(_LEFT + (value - low) / (high - low) * (_WIDTH - _LEFT - 20.0))

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
    parts.append(element("line", x1=_LEFT, x2=_WIDTH - 20.0, y1=base, y2=base, stroke="black"))
    parts.append(
        element("line", x1=x_of(adjusted), x2=x_of(adjusted), y1=_TOP / 2, y2=base, stroke=RED, stroke_width=2)
    )
    digits = max(2, math.ceil(-math.log10((high - low) / _TICKS)) + 1)
    parts += [
        label(x_of(tick), base + 22, f"{tick:.{digits}f}", text_anchor="middle")
        for tick in np.linspace(low, high, _TICKS)
    ]
    parts.append(label(_LEFT, _TOP - 6, f"weight, up to {consensus.histogram.max():.0%}"))
    parts.append(label(_WIDTH / 2, _HEIGHT - 4, "λ (half diagonal)", text_anchor="middle"))
    return drawing(_WIDTH, _HEIGHT, parts, "votes on λ")
