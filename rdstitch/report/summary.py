"""What came out, in words and numbers; what the user should know; what is missing; how and how fast it was made."""

import math
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from datetime import datetime
from importlib.metadata import version
from typing import Any

import numpy as np

from rdstitch.messages import of_severity
from rdstitch.options import StitchOptions
from rdstitch.registration import Registration
from rdstitch.report.geometry import of_source
from rdstitch.report.svg import element, joined, section, table
from rdstitch.stitch_result import StitchResult

_THUMBNAIL = 200  # pixels of the longer side


def summary(registration: Registration, result: StitchResult | None) -> str:
    """λ and everything else of which there is one number, with the verdict."""
    alignment, camera, reason = registration.alignment, registration.camera, registration.alignment.model_reason
    known = {str(source.path) for source in registration.sources}
    unread = sum(message.images[0] not in known for message in registration.left_out)
    verdict = element("p", "The result passed its own checks.", class_="good")
    if not registration.ok:
        failures = "; ".join(message.clause for message in registration.failures)
        verdict = element("p", f"Not to be relied on: {failures}", class_="bad")
    rows = [
        ("λ (half diagonal)", _lambda(registration)),
        ("λ per px²", f"{camera.distortion_px:.4e}"),
        ("images", f"{int(alignment.used.sum())} of {len(alignment.used) + unread}"),
        ("pairs", f"{sum(fit.used for fit in alignment.links)} used of {len(registration.pairs)} compared"),
        ("error", f"{alignment.rms:.3f} pixels rms of all inliers"),
        ("motion", reason if reason.startswith(f"{alignment.model}:") else f"{alignment.model}: {reason}"),
        ("scene", alignment.relief.explanation),
        ("reference", registration.sources[alignment.reference].name),
    ]
    if alignment.tilt is not None:
        rows.append(("tilt ψ, θ", "{:.2f}°, {:.2f}°".format(*np.degrees(alignment.tilt))))
    if camera.focal is not None:
        std = "" if camera.focal_std is None else f" ± {camera.focal_std:.1f}"
        rows.append(("focal length", f"{camera.focal:.1f}{std} pixels ({camera.focal_source})"))
    if result is not None:
        rows.append(("output", "{} x {} pixels".format(*result.canvas.size)))
    return section("Summary", "", verdict, table(rows))


def notices(registration: Registration) -> str:
    """Warnings, and images that were left out, each with the reason."""
    told = [
        message.clause for severity in ("warning", "note") for message in of_severity(registration.messages, severity)
    ]
    listed = element("p", "No warnings.")
    if told:
        listed = joined(element("h3", "What to look at"), element("ul", (element("li", item) for item in told)))
    return section("Warnings and left-out images", "", listed, _left_out(registration))


def _left_out(registration: Registration) -> str:
    """Small versions of the images that are not in the result, each with the reason."""
    if not registration.left_out:
        return element("p", "Every image is in the result.")
    sources = {str(source.path): source for source in registration.sources}
    shown = []
    for message in registration.left_out:
        source = sources.get(message.images[0])
        image = None if source is None else of_source(source, _THUMBNAIL)
        drawn = "" if image is None else element("img", src=image, alt="")
        shown.append(element("figure", drawn, element("figcaption", f"{message.images[0]}: {message.text}")))
    return joined(element("h3", "Left out"), element("div", shown, class_="thumbnails"))


def _lambda(registration: Registration) -> str:
    alignment = registration.alignment
    if not math.isfinite(alignment.distortion_std):
        return "not observable"
    if alignment.distortion_std == 0.0:
        return f"{alignment.distortion:.6f} (given)"
    return f"{alignment.distortion:.6f} ± {alignment.distortion_std:.6f}"


def run(options: StitchOptions | None, command: str) -> str:
    """Date, version, command line, and the options that are not the defaults."""
    rows = [("date", datetime.now().astimezone().strftime("%Y-%m-%d %H:%M:%S %Z")), ("rdstitch", version("rdstitch"))]
    if command:
        rows.append(("command", command))
    if options is not None:
        changed = _changed(options, type(options)())
        rows.append(("options", "; ".join(changed) if changed else "all as usual"))
    return section("Run", "", table(rows))


def _changed(options: Any, defaults: Any, prefix: str = "") -> list[str]:
    """``name = value`` of every option that differs."""
    found = []
    for field in fields(options):
        value, default = getattr(options, field.name), getattr(defaults, field.name)
        if is_dataclass(value) and type(value) is type(default):
            found += _changed(value, default, f"{prefix}{field.name}.")
        elif value != default:
            found.append(f"{prefix}{field.name} = {value}")
    return found


def timings(stages: Sequence[tuple[str, float]]) -> str:
    """Seconds of each stage, in their order."""
    if not stages:
        return section("Timings", "They were not measured.")
    total = sum(seconds for _, seconds in stages)
    rows = ((name, f"{seconds:.2f} s") for name, seconds in stages)
    return section("Timings", f"{total:.1f} s on the clock in all.", table(rows))
