"""The page: all sections in one self-contained HTML file."""

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from rdstitch.outputs import Outputs
from rdstitch.registration import Registration
from rdstitch.report.lens import lens_curve, votes
from rdstitch.report.output import local_alignment, mosaic, place, trajectory
from rdstitch.report.pairs import match_graph, matched, residual_map
from rdstitch.report.stage import stage
from rdstitch.report.summary import notices, run, summary, timings
from rdstitch.report.svg import Content, Markup, element, joined
from rdstitch.stitch_result import StitchResult

REPORT_SUFFIXES = (".html", ".htm")

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
        Name and seconds of each stage; see :class:`rdstitch.progress.StageTimer`.
    command : str
        The command line that made the result, if any.
    outputs : Outputs, optional
        Where the report is staged, to be published with the image; without, it replaces what is there.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    if outputs is None:
        with Outputs(overwrite=True) as alone:
            write_report(path, result, stages, command, outputs=alone)
        return
    output = result.output if isinstance(result, StitchResult) else None
    page = report_page(result, stages, command, None if output is None else outputs.staged(output))
    # Names of files need not be UTF-8.
    outputs.write(path, page.encode("utf-8", "backslashreplace"))


def report_page(
    result: StitchResult | Registration,
    stages: Sequence[tuple[str, float]] = (),
    command: str = "",
    staged: Path | None = None,
) -> str:
    """The report as HTML; see :func:`write_report`. ``staged`` is the image's file until it is published."""
    stitched = result if isinstance(result, StitchResult) else None
    registration = result.registration if isinstance(result, StitchResult) else result
    title = "rdstitch report" if stitched is None or stitched.output is None else stitched.output.name
    body: list[Content] = [
        summary(registration, stitched),
        notices(registration),
        stage(registration),
        "" if stitched is None else mosaic(stitched, staged),
        "" if stitched is None else place(stitched),
        match_graph(registration),
        votes(registration),
        lens_curve(registration),
        matched(registration),
        residual_map(registration),
        "" if stitched is None or stitched.plan is not None else local_alignment(stitched),
        trajectory(registration),
        timings(stages),
        run(None if stitched is None else stitched.options, command),
    ]
    head = Markup(f'<meta charset="utf-8"><meta name="viewport" content="{_VIEWPORT}"><style>{_STYLE}</style>')
    footer = element("footer", element("p", f"rdstitch {version('rdstitch')}"))
    return joined(
        Markup("<!DOCTYPE html>\n"),
        element(
            "html",
            element("head", head, element("title", title)),
            element("body", element("h1", title), body, footer),
            lang="en",
        ),
    )
