"""``rdstitch mosaic``: a folder of frames becomes one rectified image."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from rdstitch.options.files_beside import FilesBeside
from rdstitch.options.option import Option
from rdstitch.options.shared_options import Every
from rdstitch.results.messages import shortened
from rdstitch_cli.flags import ImageFile, Inputs, PrintSidecar, command, flags_of
from rdstitch_cli.following import FOLLOWING, followed, print_result
from rdstitch_cli.stitching import STITCHING, files_beside, report_applied, resolve, stitch_options, summarize
from rdstitch_cli.terminal import Reporter

if TYPE_CHECKING:
    from rdstitch.inputs.frame import Named
    from rdstitch.results.stitch_result import StitchResult


@command(
    """
  rdstitch mosaic floor/ -o floor.tif
  rdstitch mosaic flight/*.jpg -o field.tif --camera camera.json
  find . -name '*.jpg' -print0 | rdstitch mosaic - -o all.tif
  rdstitch mosaic drive.mp4 -o drive.png --report drive.html
  rdstitch mosaic incoming/ -o field.jpg --follow --idle 30
""",
    STITCHING,
    flags_of(FilesBeside),
    FOLLOWING,
)
def mosaic(
    inputs: Inputs,
    output: ImageFile,
    *,
    every: Every = None,
    bands: Annotated[
        str | None,
        Option(
            "Images of several bands by their names: the first one is registered, and the lenses of the others to it; "
            "each becomes a file, OUTPUT with - and the band's name before its suffix, and a TIFF of all becomes "
            "OUTPUT.",
            "NAME=PATTERN,…",
        ),
    ] = None,
    all_blocks: Annotated[
        bool,
        Option(
            "Stitch every block of overlapping images: the largest becomes OUTPUT, the others OUTPUT with -2, -3, … "
            "before its suffix."
        ),
    ] = False,
    refresh: Annotated[
        float,
        Option(
            "With --follow: seconds between updates of the preview, OUTPUT with .preview.jpg; 0: none.",
            "SECONDS",
            least=0.0,
        ),
    ] = 5.0,
    as_json: PrintSidecar = False,
    following: bool,
    idle: float | None,
    reporter: Reporter,
    **given: Any,
) -> None:
    """Stitch a whole sequence over one plane, seen straight from above.

    INPUT is a folder, an image, a quoted pattern, @FILE with one input a line (or separated by NUL), - for such a
    list on standard input, a video, or a ROS bag. Images that do not fit are left out and named on standard error.
    With --follow, frames are registered as they arrive.
    """
    from rdstitch.pipeline.blocks import mosaic_blocks
    from rdstitch.pipeline.recipes import mosaic as recipe

    if all_blocks and (following or given["strict"]):
        raise click.UsageError("--all-blocks goes neither with --follow nor with --strict")
    if bands is not None and (all_blocks or following or given["dry_run"]):
        raise click.UsageError("--bands goes neither with --all-blocks, --follow nor --dry-run")
    beside = files_beside(given)
    options = stitch_options(reporter, given, pose_covariance=beside.poses is not None)
    with ExitStack() as stack:
        paths: Sequence[Named]
        if following:
            arrived = followed(
                inputs, options, reporter, output=output, every=every, idle=idle, refresh=refresh, beside=beside
            )
            paths = stack.enter_context(arrived)
        else:
            paths = resolve(inputs)
        if bands is not None:
            from rdstitch.pipeline.bands import mosaic_bands, parse_bands  # with all that reads an earlier result

            patterns = parse_bands(bands)
            first, others = mosaic_bands(
                paths, output, patterns, options, every=every, progress=reporter, beside=beside
            )
            _report(first, reporter, as_json=as_json)
            for other in others:
                report_applied(other, reporter)
        elif all_blocks:
            for block in mosaic_blocks(paths, output, options, every=every, progress=reporter, beside=beside):
                _report(block, reporter, as_json=as_json, images=f" ({shortened(block.registration.used_names)})")
        else:
            result = recipe(paths, output, options, every=every, progress=reporter, beside=beside)
            _report(result, reporter, as_json=as_json, line_of=output if following else None)


def _report(
    result: "StitchResult", reporter: Reporter, *, as_json: bool, images: str = "", line_of: Path | None = None
) -> None:
    """What came of the images: the last line of JSON of a run that followed them, the sidecar, or λ."""
    if line_of is not None and not as_json:
        print_result(result.registration, reporter, line_of)
    else:
        summarize(result, reporter, as_json=as_json)
    if result.plan is None:
        reporter.made(f"{result.summary}{images}")
