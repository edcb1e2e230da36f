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
from rdstitch_cli import following as live
from rdstitch_cli.flags import ImageFile, Inputs, PrintSidecar, command, flags_of
from rdstitch_cli.following import FOLLOWING
from rdstitch_cli.stitching import STITCHING, files_beside, report_applied, resolve, stitch_options, summarize
from rdstitch_cli.terminal import Reporter

if TYPE_CHECKING:
    from rdstitch.inputs.frame import Named
    from rdstitch.pipeline.recomposition import Recomposition
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
    map_server: Annotated[
        Path | None,
        Option(
            "Write map.yaml and map.png, which nav2_map_server loads, into DIR; in metres by --height, with the first "
            "image at the origin and its top along x.",
            "DIR",
        ),
    ] = None,
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
    from rdstitch.pipeline.map_server import map_files, write_map
    from rdstitch.pipeline.recipes import mosaic as recipe

    if all_blocks and (following or given["strict"]):
        raise click.UsageError("--all-blocks goes neither with --follow nor with --strict")
    patterns = _bands(bands)
    if patterns and (all_blocks or following or given["dry_run"]):
        raise click.UsageError("--bands goes neither with --all-blocks, --follow nor --dry-run")
    if map_server is not None and (suffix := output.suffix.lower()) in (".dzi", ".zarr"):
        raise click.UsageError(f"--map-server is made from the output: write .png, .jpg or .tif instead of {suffix}")
    if map_server is not None and given["height"] is None:
        raise click.UsageError("--map-server is in metres: give the height of the first image's camera with --height")
    if map_server is not None and not given["dry_run"]:
        map_files(map_server, overwrite=given["overwrite"])
    with ExitStack() as stack:
        named = list(inputs) if following else resolve(inputs)
        with_poses = given["poses"] is not None
        beside = files_beside(given)
        stitch = stitch_options(reporter, given, pose_covariance=with_poses)
        paths: Sequence[Named] = named
        if following:
            watched: dict[str, Any] = {"output": output, "every": every, "idle": idle, "refresh": refresh}
            paths = stack.enter_context(live.followed(inputs, stitch, reporter, **watched, beside=beside))
        how: dict[str, Any] = {"every": every, "progress": reporter, "beside": beside}
        others: Sequence[Recomposition] = ()
        if patterns:
            from rdstitch.pipeline.bands import mosaic_bands

            first, others = mosaic_bands(paths, output, patterns, stitch, **how)
            results: Sequence[StitchResult] = [first]
        elif all_blocks:
            results = mosaic_blocks(paths, output, stitch, **how)
        else:
            results = [recipe(paths, output, stitch, **how)]
        for result in results:
            if following and not as_json:
                live.print_result(result.registration, reporter, output)
            else:
                summarize(result, reporter, as_json=as_json)
            if map_server is not None and result.plan is None and result is results[0]:
                write_map(result, map_server, beside.height or 1.0, overwrite=stitch.overwrite)
            if result.plan is None:
                images = f" ({shortened(result.registration.used_names)})" if all_blocks else ""
                reporter.made(f"{result.summary}{images}")
        for other in others:
            report_applied(other, reporter)


def _bands(text: str | None) -> dict[str, str]:
    """Patterns of images by the names of bands."""
    pairs = [part.partition("=") for part in text.split(",")] if text is not None else []
    bands = {name.strip(): pattern.strip() for name, _, pattern in pairs}
    names = "".join(bands)
    if pairs and (
        len(bands) < max(2, len(pairs)) or not all(bands) or not all(bands.values()) or set("/\\") & set(names)
    ):
        raise click.BadParameter(f"{text!r} is not a list like NIR=*_NIR.TIF,RED=*_RED.TIF", param_hint="'--bands'")
    return bands
