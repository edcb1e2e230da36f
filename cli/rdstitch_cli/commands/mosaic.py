"""``rdstitch mosaic``: a folder of frames becomes one rectified image."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rdstitch.results.messages import shortened
from rdstitch_cli import following as live
from rdstitch_cli import options
from rdstitch_cli.help_pages import command
from rdstitch_cli.option_texts import option
from rdstitch_cli.parameter_types import BANDS, RealNumber
from rdstitch_cli.stitching import files_beside, report_applied, stitch_options, summarize
from rdstitch_cli.terminal import Reporter

if TYPE_CHECKING:
    from rdstitch.inputs.frame import Named
    from rdstitch.pipeline.apply_sidecar import Recomposition
    from rdstitch.results.stitch_result import StitchResult


@command(
    "One rectified image of a whole folder or video.",
    """
  rdstitch mosaic floor/ -o floor.tif
  rdstitch mosaic flight/*.jpg -o field.tif --camera camera.json
  find . -name '*.jpg' -print0 | rdstitch mosaic - -o all.tif
  rdstitch mosaic drive.mp4 -o drive.png --report drive.html
  rdstitch mosaic incoming/ -o field.jpg --follow --idle 30
""",
)
@options.inputs
@options.stitching
@options.every
@options.topic
@option("--bands", BANDS)
@option("--all-blocks", bool)
@option("--poses", options.IMAGE)
@option("--frame", ("enu", "ros", "camera", "map"), "enu", of="mosaic")
@option("--height", RealNumber(0.0, min_open=True), 1.0)
@option("--map-server", options.IMAGE)
@options.follow
@option("--refresh", RealNumber(0.0), 5.0)
def mosaic(
    inputs: tuple[Path, ...],
    output: Path,
    every: int | None,
    bands: dict[str, str] | None,
    all_blocks: bool,
    following: bool,
    idle: float | None,
    refresh: float,
    map_server: Path | None,
    as_json: bool,
    reporter: Reporter,
    **given: Any,
) -> None:
    """Stitch a whole sequence over one plane, seen straight from above.

    INPUT is a folder, an image, a quoted pattern, @FILE with one input a line (or separated by NUL), - for such a
    list on standard input, a video, or a ROS bag. Images that do not fit are left out and named on standard error.
    With --follow, frames are registered as they arrive.
    """
    from rdstitch.pipeline.map_server import map_files, write_map
    from rdstitch.pipeline.recipes import mosaic as recipe
    from rdstitch.pipeline.recipes import mosaic_blocks

    if all_blocks and (following or given["strict"]):
        raise click.UsageError("--all-blocks goes neither with --follow nor with --strict")
    if bands and (all_blocks or following or given["dry_run"]):
        raise click.UsageError("--bands goes neither with --all-blocks, --follow nor --dry-run")
    if map_server is not None and output.suffix.lower() == ".dzi":
        raise click.UsageError("--map-server is made from the output: write .png, .jpg or .tif instead of .dzi")
    if map_server is not None and not given["dry_run"]:
        map_files(map_server, overwrite=given["overwrite"])
    with ExitStack() as stack:
        named = list(inputs) if following else options.resolve(inputs)
        with_poses = given["poses"] is not None
        beside = files_beside(reporter, given)
        stitch = stitch_options(reporter, pose_covariance=with_poses, **given)
        paths: Sequence[Named] = named
        if following:
            watched: dict[str, Any] = {"output": output, "every": every, "idle": idle, "refresh": refresh}
            paths = stack.enter_context(live.followed(inputs, stitch, reporter, **watched, beside=beside))
        how: dict[str, Any] = {"every": every, "progress": beside.timer, "beside": beside}
        others: Sequence[Recomposition] = ()
        if bands:
            from rdstitch.pipeline.bands import mosaic_bands

            first, others = mosaic_bands(paths, output, bands, stitch, **how)
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
                write_map(result, map_server, beside.height, overwrite=stitch.overwrite)
            if result.plan is None:
                images = f" ({shortened(result.registration.used_names)})" if all_blocks else ""
                reporter.made(f"{result.summary}{images}")
        for other in others:
            report_applied(other, reporter)
