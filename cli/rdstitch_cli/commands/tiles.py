"""``rdstitch tiles``: tiles from a motorised stage become one image, or a table of places."""

from pathlib import Path
from typing import Any

import click

from rdstitch_cli import options
from rdstitch_cli.help_pages import GroupedCommand
from rdstitch_cli.parameter_types import RealNumber, WholeNumber
from rdstitch_cli.stitching import Report, composite_fields, report_registration, summarize
from rdstitch_cli.terminal import Reporter


@click.command(
    cls=GroupedCommand,
    short_help="One image of tiles taken on a microscope's stage.",
    epilog="""\b
Examples:
  rdstitch tiles slide/ --grid 'r{row}c{col}' --overlap 10 -o slide.tif
  rdstitch tiles slide/*.tif --positions stage.csv -o slide.dzi
  rdstitch tiles ome/ --channel 0 -o slide.ome.tif --report slide.html
  rdstitch tiles slide/ --grid 'r{row}c{col}' --positions-only places.csv
""",
)
@options.inputs
@click.option("-o", "--output", type=options.IMAGE, help="Image to write: .ome.tif, .tif, .png, .jpg, .webp or .dzi.")
@options.overwrite
@click.option(
    "--grid",
    metavar="PATTERN",
    help="Part of the file names, with {row} and {col} for numbers and * for anything, such as 'r{row}c{col}'.",
)
@click.option(
    "--overlap",
    type=RealNumber(0.0, 100.0),
    default=10.0,
    show_default=True,
    metavar="PERCENT",
    help="With --grid: what neighbours have in common.",
)
@click.option(
    "--positions",
    type=options.IMAGE,
    metavar="FILE",
    help="CSV with name,x,y (pixels) or name,x_um,y_um; otherwise what OME-TIFF or Micro-Manager say.",
)
@click.option(
    "--positions-only",
    type=options.IMAGE,
    metavar="FILE",
    help="Write the places of the tiles to this CSV file; without --output nothing is composed.",
)
@click.option("--pixel-size", type=RealNumber(0.0), metavar="UM", help="Micrometres a pixel, where no file says it.")
@click.option(
    "--search",
    type=RealNumber(0.0),
    metavar="PX",
    help="How far neighbours may be from where they should be to each other.  [default: 5 % of a tile's side]",
)
@click.option(
    "--channel", type=WholeNumber(0), metavar="N", help="Register this channel, from 0; otherwise the mean of all."
)
@options.flat_field("auto")
@click.option(
    "--save-flat-field",
    type=options.IMAGE,
    metavar="FILE",
    help="Write the flat field and the dark field to this TIFF file, for the next slide.",
)
@options.distortion
@options.cut
@options.crop
@options.interpolation
@options.output_form
@options.topic
@options.workers
@options.report
@options.strict
@options.as_json("the sidecar")
@options.verbosity
def tiles(
    inputs: tuple[Path, ...],
    output: Path | None,
    positions_only: Path | None,
    overlap: float,
    report: Path | None,
    as_json: bool,
    reporter: Reporter,
    **given: Any,
) -> None:
    """Stitch tiles that a motorised stage, a scanner or a gantry took at roughly known places.

    Neighbours are registered by correlation, so that dark tiles with little in them will do; tiles that show nothing
    keep their places. Samples stay as they were measured: images are cut where they meet, neither blended nor
    brightened.
    """
    from rdstitch.compositing import CompositeOptions
    from rdstitch.pipeline.stage_tiles import place_tiles
    from rdstitch.pipeline.stage_tiles import tiles as recipe
    from rdstitch.stage import TileOptions

    if output is None and positions_only is None:
        raise click.UsageError("nothing to write: give --output or --positions-only")
    composite = CompositeOptions(exposure="none", seam="none", **composite_fields(given))
    chosen = TileOptions(overlap=overlap / 100.0, composite=composite, **given)
    paths = options.resolve(inputs)
    page = Report(report, reporter, paths, chosen.overwrite, output)
    if output is None:
        with page.explaining():
            _, registration = place_tiles(paths, positions_only, chosen, progress=page.progress)
        report_registration(registration, reporter)
        reporter.made(f"{positions_only}: {registration.summary}")
        return
    with page.explaining():
        result = recipe(paths, output, chosen, positions_file=positions_only, progress=page.progress, beside=page.stage)
    summarize(result, reporter, as_json=as_json)
    if result.plan is None:
        reporter.made(result.summary)
