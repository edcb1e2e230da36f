"""What came out, in words and numbers; what the user should know; what is missing."""

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from rdstitch.registration import Registration
from rdstitch.report.svg import element, section, table
from rdstitch.report.thumbnails import of_source
from rdstitch.stitch_result import StitchResult

_THUMBNAIL = 200  # pixels of the longer side


def summary(registration: Registration, result: StitchResult | None) -> str:
    """λ and everything else of which there is one number, with the verdict."""
    alignment, camera = registration.alignment, registration.camera
    rows = [
        ("λ (half diagonal)", _lambda(registration)),
        ("λ per px²", f"{camera.distortion_px:.4e}"),
        ("pictures", f"{int(alignment.used.sum())} of {len(alignment.used) + _unread(registration)}"),
        ("pairs", f"{sum(fit.used for fit in alignment.links)} used of {len(registration.pairs)} compared"),
        ("error", f"{alignment.rms:.3f} pixels rms of all inliers"),
        ("motion", _motion(alignment.model, alignment.model_reason)),
        ("scene", alignment.relief.explanation),
        ("reference", registration.sources[alignment.reference].name),
    ]
    if alignment.tilt is not None:
        rows.append(("tilt ψ, θ", "{:.2f}°, {:.2f}°".format(*np.degrees(alignment.tilt))))
    if camera.focal is not None:
        rows.append(("focal length", f"{camera.focal:.1f} pixels ({camera.focal_source})"))
    if result is not None:
        rows.append(("output", "{} x {} pixels".format(*result.canvas.size)))
    return section("Summary", "", _verdict(registration), table((), rows))


def notices(registration: Registration) -> str:
    """Warnings, and pictures that were left out, each with the reason."""
    warnings = [message.clause for message in (*registration.warnings, *registration.notes)]
    return section(
        "Warnings and left-out pictures",
        "",
        _list("What to look at", warnings, "No warnings."),
        _left_out(registration),
    )


def _left_out(registration: Registration) -> str:
    """Small versions of the pictures that are not in the result, each with the reason."""
    if not registration.left_out:
        return element("p", "Every picture is in the result.")
    sources = {str(source.path): source for source in registration.sources}
    shown = []
    for message in registration.left_out:
        source = sources.get(message.images[0])
        picture = None if source is None else of_source(source, _THUMBNAIL)
        drawn = "" if picture is None else element("img", src=picture, alt="")
        caption = element("figcaption", escape(f"{message.images[0]}: {message.text}"))
        shown.append(element("figure", drawn + caption))
    return element("h3", "Left out") + element("div", "".join(shown), class_="thumbnails")


def _motion(model: str, reason: str) -> str:
    """The model with the reason for it, which may begin with its name."""
    return reason if reason.startswith(f"{model}:") else f"{model}: {reason}"


def _verdict(registration: Registration) -> str:
    if registration.ok:
        return element("p", "The result passed its own checks.", class_="good")
    failures = "; ".join(message.clause for message in registration.failures)
    return element("p", escape(f"Not to be relied on: {failures}"), class_="bad")


def _lambda(registration: Registration) -> str:
    alignment = registration.alignment
    if not math.isfinite(alignment.distortion_std):
        return "not observable"
    if alignment.distortion_std == 0.0:
        return f"{alignment.distortion:.6f} (given)"
    return f"{alignment.distortion:.6f} ± {alignment.distortion_std:.6f}"


def _unread(registration: Registration) -> int:
    known = {str(source.path) for source in registration.sources}
    return sum(message.images[0] not in known for message in registration.left_out)


def _list(title: str, items: Sequence[str], none: str) -> str:
    if not items:
        return element("p", escape(none))
    return element("h3", escape(title)) + element("ul", "".join(element("li", escape(item)) for item in items))
