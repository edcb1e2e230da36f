"""The page: all sections in one self-contained HTML file; those with drawings are files of their own."""

from collections.abc import Callable, Sequence
from datetime import datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np

from rdstitch.errors import ArgumentError
from rdstitch.georeferencing.georeference import map_summary
from rdstitch.report.lens import lens_curve, votes
from rdstitch.report.mosaic import mosaic_section
from rdstitch.report.pairs import link_residuals, match_graph, matched, residual_map
from rdstitch.report.stage import stage_section
from rdstitch.report.svg import Content, Markup, element, joined, of_source, section, table
from rdstitch.results.messages import merge_by_reason, of_severity
from rdstitch.results.registration import Registration
from rdstitch.results.stitch_result import StitchResult
from rdstitch.system.outputs import Outputs

_THUMBNAIL = 200  # pixels of the longer side
_MAX_ROWS = 20
_MAX_THUMBNAILS = 40
_VIEWPORT = "width=device-width, initial-scale=1"
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 960px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.6em; }
h2 { font-size: 1.25em; margin-top: 2em; border-bottom: 1px solid #ddd; }
h3 { font-size: 1em; }
p, li, td { overflow-wrap: anywhere; } table { border-collapse: collapse; }
td, th { padding: 0.2em 1em 0.2em 0; vertical-align: top; text-align: left; } td:first-child { white-space: nowrap; }
img, svg { display: block; width: 100%; height: auto; }
.thumbnails { display: flex; flex-wrap: wrap; gap: 1em; } figure { margin: 0; flex: 0 1 12em; }
figcaption { font-size: 0.9em; overflow-wrap: anywhere; }
@media (max-width: 600px) {
  body { margin: 0.5em auto; } td, th { display: block; padding: 0; } td:first-child { color: #666; }
}
.good { color: #1c7a36; font-weight: bold; } .bad { color: #b3261e; font-weight: bold; }
"""


def write_report(
    path: str | Path,
    result: StitchResult | Registration,
    stages: Sequence[tuple[str, float]] = (),
    command: str = "",
    *,
    outputs: Outputs | None = None,
) -> None:
    """Write the report of a result: one HTML file without anything outside of it.

    Parameters
    ----------
    path : path
    result : StitchResult or Registration
    stages : sequence of (str, float)
        Name and seconds of each stage; see :class:`rdstitch.system.progress.StageTimer`.
    command : str
        The command line that made the result, if any.
    outputs : Outputs, optional
        Where the report is staged, to be published with the image; without, it replaces what is there.

    Raises
    ------
    ArgumentError
        When the result is none of these: what was composed again has no registration.
    OutputError
        When the file cannot be written.
    """
    with Outputs.or_own(outputs) as staging:
        page = report_page(result, stages, command, staging.where)
        # Names of files need not be UTF-8.
        staging.write(path, page.encode("utf-8", "backslashreplace"))


def report_page(
    result: StitchResult | Registration,
    stages: Sequence[tuple[str, float]] = (),
    command: str = "",
    where: Callable[[Path], Path] = lambda file: file,
) -> str:
    """The report as HTML; see :func:`write_report`. ``where`` gives the file of the output until it is published."""
    if isinstance(result, StitchResult):
        registration, stitched = result.registration, result
    elif isinstance(result, Registration):
        registration, stitched = result, None
    else:
        raise ArgumentError(f"a report is made of a StitchResult or a Registration, not of a {type(result).__name__}")
    title, image = "rdstitch report", None
    if stitched is not None and stitched.output is not None:
        title, image = stitched.output.name, where(stitched.output)
    residuals = link_residuals(registration)
    body: list[Content] = [
        summary(registration, stitched),
        notices(registration),
        stage_section(registration),
        *([mosaic_section(stitched, image), place_section(stitched), local_alignment(stitched)] if stitched else []),
        match_graph(registration),
        votes(registration),
        lens_curve(registration, residuals),
        matched(registration),
        residual_map(registration, residuals),
        run_section(stages, command),
    ]
    head = Markup(f'<meta charset="utf-8"><meta name="viewport" content="{_VIEWPORT}"><style>{_STYLE}</style>')
    return joined(
        Markup("<!DOCTYPE html>\n"),
        element(
            "html",
            element("head", head, element("title", title)),
            element("body", element("h1", title), body),
            lang="en",
        ),
    )


def summary(registration: Registration, stitched: StitchResult | None) -> str:
    """λ and everything else of which there is one number, with the verdict."""
    alignment, camera, reason = registration.alignment, registration.camera, registration.alignment.model_reason
    used, compared = sum(fit.used for fit in alignment.links), len(registration.pairs)
    of_copies = f"; {more} more of copies" if (more := len(alignment.holding) - used) else ""
    known = {str(source.path) for source in registration.sources}
    unread = sum(message.images[0] not in known for message in registration.left_out)
    if not registration.ok:
        failures = "; ".join(registration.verdict.failures)
        verdict = element("p", f"Not to be relied on: {failures}", class_="bad")
    elif stitched is not None and stitched.seams.broken_in_output:
        verdict = element("p", "Seams are broken; the picture below shows where.", class_="bad")
    else:
        verdict = element("p", "The result passed its own checks.", class_="good")
    rows = [
        ("λ (half diagonal)", registration.distortion_in_words(6)),
        ("λ per px²", f"{camera.distortion_px:.4e}"),
        ("images", f"{int(alignment.used.sum())} of {len(alignment.used) + unread}"),
        ("pairs", f"{used} used of {compared} compared{of_copies}"),
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
    if stitched is not None:
        rows.append(("output", "{} x {} pixels".format(*stitched.canvas.size)))
    return section("Summary", "", verdict, table(rows))


def notices(registration: Registration) -> str:
    """Warnings, and images that were left out, each with the reason."""
    texts = [message.clause for message in (*registration.warnings, *of_severity(registration.messages, "note"))]
    listed = element("p", "No warnings.")
    if texts:
        listed = joined(element("h3", "What to look at"), element("ul", (element("li", item) for item in texts)))
    return section("Warnings and left-out images", "", listed, _left_out(registration))


def _left_out(registration: Registration) -> str:
    """Small versions of the images that are not in the result, each with the reason."""
    if not registration.left_out:
        return element("p", "Every image is in the result.")
    sources = {str(source.path): source for source in registration.sources}
    shown = []
    for message in registration.left_out[:_MAX_THUMBNAILS]:
        source = sources.get(message.images[0])
        image = None if source is None else of_source(source, _THUMBNAIL)
        drawn = "" if image is None else element("img", src=image, alt="")
        shown.append(element("figure", drawn, element("figcaption", f"{message.images[0]}: {message.text}")))
    others = merge_by_reason(registration.left_out[_MAX_THUMBNAILS:])
    more = element("p", f"And without a picture: {'; '.join(map(str, others))}.") if others else ""
    return joined(element("h3", "Left out"), element("div", shown, class_="thumbnails"), more)


def run_section(stages: Sequence[tuple[str, float]], command: str) -> str:
    """Date, version and command line, and the seconds of each stage in their order."""
    rows = [("date", datetime.now().astimezone().strftime("%Y-%m-%d %H:%M:%S %Z")), ("rdstitch", version("rdstitch"))]
    rows += [("command", command)] if command else []
    rows += [(name, f"{seconds:.2f} s") for name, seconds in stages]
    return section("Run", f"{sum(seconds for _, seconds in stages):.1f} s on the clock." if stages else "", table(rows))


def place_section(result: StitchResult) -> str:
    """Where the output lies on the Earth, and the largest residuals of the positions that say so."""
    if (placed := result.georeference) is None:
        return ""
    residuals = sorted(placed.residuals, key=lambda residual: -residual.distance)[:_MAX_ROWS]
    rows = [(r.name, _signed(r.east), _signed(r.north), "" if r.used else "not used") for r in residuals]
    explanation = (
        f"{map_summary(placed)}. Where the output has them less where they were measured to be, the largest first:"
    )
    return section("Place on the Earth", explanation, table(rows, ("", "east, m", "north, m", "")))


def _signed(value: float | None) -> str:
    return "" if value is None else f"{value:+.3f}"


def local_alignment(result: StitchResult) -> str:
    """How much local alignment mended, and the image that it moved farthest."""
    local = result.local_alignment
    if result.plan is not None:
        return ""
    if not local.fields:
        return section("Local alignment", f"Images are where the alignment puts them: {local.reason}.")
    spread = ""
    if local.before is not None and local.after is not None:
        spread = f" (95 %: {local.before.percentile95:.2f} and {local.after.percentile95:.2f} pixels)"
    moved = zip(local.fields, result.registration.used_names, strict=True)
    field, name = max(moved, key=lambda image: image[0].largest)
    return section(
        "Local alignment",
        f"No {'turn' if result.registration.alignment.on_sphere else 'plane'} fits quite, so that each image's content "
        f"is moved a little, that of {name} by up to {field.largest:.1f} pixels; {local.reason}{spread}.",
    )
