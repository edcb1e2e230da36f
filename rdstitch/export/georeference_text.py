"""What there is to say of a georeference."""

import math
from collections.abc import Sequence

from rdstitch.export.georeference import CONTROL, GPS, Georeference, Residual


def map_summary(place: Georeference) -> str:
    """Everything in one line."""
    side = "left" if place.clockwise_deg > 0 else "right"
    turned = "" if place.north_up else f", north {abs(place.clockwise_deg):.1f}° {side} of up"
    what, agree = ("GPS", "agree with the map") if place.source == GPS else (place.source, "agree")
    text = (
        f"georeferenced: {place.crs.name}, {place.gsd:.4g} m a pixel{turned}; {what} {agree} to "
        f"{metres(place.rms)} ({place.used} of {len(place.residuals)}, each predicted by the others)"
    )
    if place.source == CONTROL:
        text += f", worst {_worst(place, place.residuals)}"
    return text if place.std is None else f"{text}; map ± {metres(place.std)}"


def check_summary(place: Georeference) -> str:
    """How far check points are off, in one line."""
    rms = math.sqrt(sum(check.off**2 for check in place.checks) / max(len(place.checks), 1))
    worst = _worst(place, place.checks)
    return f"{len(place.checks)} check points: {metres(rms)} off horizontally (rms), worst {worst}"


def _worst(place: Georeference, residuals: Sequence[Residual]) -> str:
    worst = max((one for one in residuals if one.used), key=lambda one: one.off)
    return f"{worst.name} by {metres(worst.off)} = {worst.off / abs(place.scale):.1f} pixels"


def metres(value: float) -> str:
    """A length with its unit, to two digits, but no finer than a millimetre."""
    digits = max(0, min(3, 1 - math.floor(math.log10(value)))) if value > 0.0 and math.isfinite(value) else 1
    return f"{value:.{digits}f} m"
