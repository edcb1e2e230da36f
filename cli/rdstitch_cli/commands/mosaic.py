"""``rdstitch mosaic``: a folder of frames becomes one rectified image."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from rdstitch.errors import ArgumentError
from rdstitch.options.files_beside import FilesBeside
from rdstitch.options.option import Contradiction, Option, Range
from rdstitch.options.shared_options import Every
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.results.messages import shortened
from rdstitch_cli.flags import ImageFile, Inputs, PrintSidecar, command, flags_of
from rdstitch_cli.following import Following, Idle, print_followed, print_result, source_to_follow
from rdstitch_cli.stitching import (
    STITCHING,
    Preview,
    files_beside,
    report_applied,
    report_result,
    resolve,
    stitch_options,
)
from rdstitch_cli.terminal import Reporter

if TYPE_CHECKING:
    from rdstitch.pipeline.live_source import LiveSource

_CONTRADICTIONS = (
    Contradiction(("following",), ("dry_run",), "--follow has no --dry-run: frames are registered as they arrive"),
    Contradiction(
        ("all_blocks",), ("following", "strict"), "--all-blocks goes neither with --follow nor with --strict"
    ),
    Contradiction(
        ("bands",),
        ("all_blocks", "following", "dry_run"),
        "--bands goes neither with --all-blocks, --follow nor --dry-run",
    ),
)


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
            "OUTPUT. --json prints the sidecar of the first band.",
            "NAME=PATTERN,…",
        ),
    ] = None,
    all_blocks: Annotated[
        bool,
        Option(
            "Stitch every block of overlapping images: the largest becomes OUTPUT, the others OUTPUT with -2, -3, … "
            "before its suffix. --json prints a sidecar for each."
        ),
    ] = False,
    refresh: Annotated[
        float,
        Option(
            "With --follow: seconds between updates of the preview, OUTPUT with .preview.jpg; 0: none.",
            "SECONDS",
            within=Range(least=0.0),
            needs=("following",),
        ),
    ] = 5.0,
    preview: Preview = False,
    as_json: PrintSidecar = False,
    following: Following = False,
    idle: Idle = None,
    reporter: Reporter,
    **given: Any,
) -> None:
    """Stitch a whole sequence over one plane, seen straight from above.

    INPUT is a folder, an image, a quoted pattern, @FILE with one input a line (or separated by NUL), - for such a
    list on standard input, a video, or a ROS bag. Images that do not fit are left out and named on standard error.
    With --follow, frames are registered as they arrive.
    """
    chosen = {**given, "bands": bands, "all_blocks": all_blocks, "following": following}
    for contradiction in _CONTRADICTIONS:
        if all(any(map(chosen.get, side)) for side in (contradiction.names, contradiction.others)):
            raise click.UsageError(contradiction.reason)
    options = stitch_options(given, preview=preview)
    how: dict[str, Any] = {"every": every, "progress": reporter, "beside": files_beside(given)}
    if bands is not None:
        _stitch_bands(inputs, output, bands, options, how, reporter, as_json=as_json)
    elif all_blocks:
        _stitch_blocks(inputs, output, options, how, reporter, as_json=as_json)
    elif following:
        _follow(source_to_follow(inputs, every, idle), output, options, how, reporter, refresh=refresh, as_json=as_json)
    else:
        from rdstitch.pipeline.recipes import mosaic as recipe

        report_result(recipe(resolve(inputs), output, options, **how), reporter, as_json=as_json)


def _stitch_bands(
    inputs: Inputs,
    output: Path,
    bands: str,
    options: StitchOptions,
    how: Mapping[str, Any],
    reporter: Reporter,
    *,
    as_json: bool,
) -> None:
    from rdstitch.pipeline.bands import mosaic_bands  # with all that reads an earlier result

    first, others = mosaic_bands(resolve(inputs), output, _parse_bands(bands), options, **how)
    report_result(first, reporter, as_json=as_json)
    for other in others:
        report_applied(other, reporter)


def _stitch_blocks(
    inputs: Inputs, output: Path, options: StitchOptions, how: Mapping[str, Any], reporter: Reporter, *, as_json: bool
) -> None:
    from rdstitch.pipeline.blocks import mosaic_blocks

    for block in mosaic_blocks(resolve(inputs), output, options, **how):
        names = shortened(block.registration.used_names)
        report_result(block, reporter, as_json=as_json, more=f" ({names})")


def _follow(
    source: "LiveSource",
    output: Path,
    options: StitchOptions,
    how: Mapping[str, Any],
    reporter: Reporter,
    *,
    refresh: float,
    as_json: bool,
) -> None:
    from rdstitch.pipeline.live_source import follow_for_mosaic
    from rdstitch.pipeline.recipes import mosaic as recipe

    with follow_for_mosaic(source, output, options, how["beside"], refresh=refresh) as frames:
        print_followed(frames, reporter)
        result = recipe(frames.images, output, frames.given.options, **how)
        if as_json:
            report_result(result, reporter, as_json=True)
        else:
            print_result(result.registration, reporter, output)
            reporter.made(result.summary)


def _parse_bands(text: str) -> dict[str, str]:
    """Patterns of images by the names of bands, of ``NIR=*_NIR.TIF,RED=*_RED.TIF``."""
    pairs = [part.partition("=") for part in text.split(",")]
    bands = {name.strip(): pattern.strip() for name, _, pattern in pairs}
    if len(bands) < len(pairs) or not all(bands.values()):
        raise ArgumentError(f"--bands: {text!r} is not a list like NIR=*_NIR.TIF,RED=*_RED.TIF")
    return bands
