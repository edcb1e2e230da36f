"""``rdstitch mosaic``: a folder of frames becomes one rectified picture."""

from pathlib import Path
from typing import Any

import click

from rdstitch_cli import options
from rdstitch_cli.help_pages import GroupedCommand
from rdstitch_cli.progress import Reporter
from rdstitch_cli.stitching import Report, stitch_options, summarize


@click.command(
    cls=GroupedCommand,
    epilog="""\b
Examples:
  rdstitch mosaic floor/ -o floor.tif
  rdstitch mosaic flight/*.jpg -o field.tif --camera camera.json
  find . -name '*.jpg' -print0 | rdstitch mosaic - -o all.tif
  rdstitch mosaic drive.mp4 --every 10 -o drive.png --report drive.html
""",
)
@options.inputs
@options.output
@options.overwrite
@options.every
@options.topic
@click.option("--reference", metavar="NAME", help="Picture that sets the frame; otherwise the best connected one.")
@options.preview
@options.known
@options.estimation
@options.local_alignment
@options.compositing
@click.option(
    "--save-camera",
    type=options.PICTURE,
    metavar="FILE",
    help="Write the estimated camera to FILE: .json, .yml (OpenCV), .pto (Hugin), camera_info.yaml (ROS) and others.",
)
@options.report
@options.trust
@options.as_json
@options.verbosity
def mosaic(
    inputs: tuple[Path, ...],
    output: Path,
    every: int,
    report: Path | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **given: Any,
) -> None:
    """Stitch a whole sequence over one plane, seen straight from above.

    INPUT is a folder, a picture, a quoted pattern, @FILE with one input a line (or separated by NUL), - for such a
    list on standard input, a video, or a ROS bag. Pictures that do not fit are left out and named on standard error.
    """
    from rdstitch.pipeline import mosaic as recipe

    with Reporter(-quiet + verbose) as reporter:
        paths = options.resolve(inputs)
        report_page = Report(report, reporter, paths, given["overwrite"], output)
        with report_page.explaining():
            result = recipe(
                paths, output, stitch_options(reporter, **given), every=every, progress=report_page.progress
            )
        summarize(result, reporter, as_json=as_json)
        report_page.write(result)
        if result.plan is None:
            reporter.made(result.summary)
