"""``rdstitch tiles``: tiles from a motorised stage become one image, or a table of places."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rdstitch.errors import PartialResultError
from rdstitch_cli import options
from rdstitch_cli.help_pages import command
from rdstitch_cli.option_texts import option
from rdstitch_cli.parameter_types import LENS, RealNumber, WholeNumber, word_or_number
from rdstitch_cli.stitching import composite_fields, files_beside, report_registration, summarize
from rdstitch_cli.terminal import Reporter

ORDERS = ("rows", "columns", "snake-rows", "snake-columns")
ORIGINS = ("top-left", "top-right", "bottom-left", "bottom-right")

if TYPE_CHECKING:
    from rdstitch.stage import TileRegistration


@command(
    "One image of tiles taken on a microscope's stage.",
    """
  rdstitch tiles slide/ --grid 'r{row}c{col}' --overlap 10 -o slide.tif
  rdstitch tiles slide/*.tif --positions stage.csv -o slide.dzi
  rdstitch tiles ome/ --channel 0 -o slide.ome.tif --report slide.html
  rdstitch tiles slide/ --grid 'r{row}c{col}' --positions-only places.csv
  rdstitch tiles plate/ --grid '{letter}{col}' --overlap 8 -o plate.ome.tif                   # A01, A02, …
  rdstitch tiles sem/ --grid 'img_{number}' --columns 12 --order snake-rows -o sem.tif
  rdstitch tiles sem/ --grid 'img_{number}' --columns 12 --origin bottom-left -o sem.tif
  rdstitch tiles slide/ --positions TileConfiguration.txt --z max -o slide.ome.zarr
""",
)
@options.inputs
@option("-o --output", options.IMAGE, of="tiles")
@options.overwrite
@option("--grid")
@option("--overlap", RealNumber(0.0, 100.0), 10.0)
@option("--columns", WholeNumber(1))
@option("--order", ORDERS, "rows")
@option("--origin", ORIGINS, "top-left")
@option("--positions", options.IMAGE, of="tiles")
@option("--positions-only", options.IMAGE)
@option("--pixel-size", RealNumber(0.0))
@option("--search", RealNumber(0.0))
@option("--channel", WholeNumber(0))
@option("--z", word_or_number(("max",), 0, 1_000_000))
@option("--time", WholeNumber(0))
@options.flat_field
@option("--save-flat-field", options.IMAGE)
@option("--lambda", LENS, dest="distortion")
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
    paths = options.resolve(inputs)
    beside = files_beside(reporter, given)
    composite = CompositeOptions(exposure="none", seam="none", **composite_fields(given))
    chosen = TileOptions(overlap=overlap, composite=composite, **given)
    if output is None:
        tiled, registration = place_tiles(paths, positions_only, chosen, progress=beside.timer)
        report_registration(registration, reporter)
        reporter.made(f"{positions_only}: {registration.summary}")
        _check_placed(tiled)
        return
    result = recipe(paths, output, chosen, positions_file=positions_only, progress=beside.timer, beside=beside)
    summarize(result, reporter, as_json=as_json)
    if result.plan is None:
        reporter.made(result.summary)
    _check_placed(result.registration.tiles)


def _check_placed(tiled: "TileRegistration | None") -> None:
    """End with the status of a partial result where most tiles lie where the stage was told to go, right or wrong."""
    if tiled is not None and tiled.mostly_nominal:
        alone = len(tiled.grid) - int(tiled.linked.sum())
        raise PartialResultError(
            f"{alone} of {len(tiled.grid)} tiles have their places from the stage alone: they show nothing, or "
            f"the places ({tiled.grid.source}) or the overlap are wrong; what could be placed is written"
        )
