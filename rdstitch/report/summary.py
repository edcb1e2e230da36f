"""What came out, in words and numbers; what the user should know; what is missing."""

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from rdstitch.registration import Registration
from rdstitch.report.svg import element, section, table
from rdstitch.stitch_result import StitchResult
from rdstitch.verification.verdict import Verdict


def summary(registration: Registration, result: StitchResult | None, verdict: Verdict | None = None) -> str:
    """λ and everything else of which there is one number, with the verdict where there is one."""
    alignment, camera = registration.alignment, registration.camera
    rows = [
        ("λ (half diagonal)", _lambda(registration)),
        ("λ per px²", f"{camera.distortion_px:.4e}"),
        ("pictures", f"{int(alignment.used.sum())} of {len(alignment.used) + _unread(registration)}"),
        ("pairs", f"{sum(fit.used for fit in alignment.links)} used of {len(registration.pairs)} looked at"),
        ("error", f"{alignment.rms:.3f} px rms of all inliers"),
        ("motion", f"{alignment.model}: {alignment.model_reason}"),
        ("scene", alignment.relief.explanation),
        ("reference", registration.sources[alignment.reference].name),
    ]
    if alignment.tilt is not None:
        rows.append(("tilt ψ, θ", "{:.2f}°, {:.2f}°".format(*np.degrees(alignment.tilt))))
    if camera.focal is not None:
        rows.append(("focal length", f"{camera.focal:.1f} px ({camera.focal_source})"))
    if result is not None:
        rows.append(("output", "{} x {} px".format(*result.canvas.size)))
    return section("Summary", "", _verdict(verdict if result is None else result.verdict), table((), rows))


def notices(registration: Registration, result: StitchResult | None, verdict: Verdict | None = None) -> str:
    """Warnings, and pictures that were left out, each with the reason."""
    doubts = () if verdict is None else verdict.doubts
    warnings = (*registration.alignment.warnings, *doubts) if result is None else result.warnings
    missing = [f"{item.path}: {item.reason}" for item in registration.left_out]
    return section(
        "Warnings and left-out pictures",
        "",
        _list("What to look at", warnings, "No warnings."),
        _list("Left out", missing, "Every picture is in the result."),
    )


def _verdict(verdict: Verdict | None) -> str:
    if verdict is None:
        return ""
    if verdict.ok:
        return element("p", "The result passed its own checks.", class_="good")
    return element("p", escape("Not to be relied on: " + "; ".join(verdict.failures)), class_="bad")


def _lambda(registration: Registration) -> str:
    alignment = registration.alignment
    if not math.isfinite(alignment.distortion_std):
        return "not observable"
    if alignment.distortion_std == 0.0:
        return f"{alignment.distortion:.6f} (given)"
    return f"{alignment.distortion:.6f} ± {alignment.distortion_std:.6f}"


def _unread(registration: Registration) -> int:
    known = {source.path for source in registration.sources}
    return sum(item.path not in known for item in registration.left_out)


def _list(title: str, items: Sequence[str], none: str) -> str:
    if not items:
        return element("p", escape(none))
    return element("h3", escape(title)) + element("ul", "".join(element("li", escape(item)) for item in items))
