"""``rdstitch tiles``: tiles from a motorised stage become one image, or a table of places."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import click

from rdstitch.errors import PartialResultError
from rdstitch.options.composite_options import CompositeOptions
from rdstitch.options.files_beside import ReportFile
from rdstitch.options.option import FileUse, Option
from rdstitch.options.tile_options import TileOptions, measured_samples
from rdstitch_cli.flags import Inputs, PrintSidecar, command, flags_of, values_of
from rdstitch_cli.stitching import files_beside, report_registration, report_result, resolve
from rdstitch_cli.terminal import Reporter


@command(
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
    flags_of(TileOptions),
    flags_of(measured_samples(), only="blend crop interpolation background max_memory scale max_size quality"),
    flags_of(ReportFile),
)
def tiles(
    inputs: Inputs,
    output: Annotated[
        Path | None,
        Option(
            "Image to write: .ome.tif, .ome.zarr, .tif, .png, .jpg, .webp or .dzi.",
            flag="-o --output",
            file=FileUse.WRITTEN,
        ),
    ] = None,
    positions_only: Annotated[
        Path | None,
        Option(
            "Write the places of the tiles to this CSV file, or to a .txt as Fiji's list; without --output nothing is "
            "composed.",
            "FILE",
            file=FileUse.WRITTEN,
        ),
    ] = None,
    as_json: PrintSidecar = False,
    *,
    reporter: Reporter,
    **given: Any,
) -> None:
    """Stitch tiles that a motorised stage, a scanner or a gantry took at roughly known places.

    Neighbours are registered by correlation, so that dark tiles with little in them will do; tiles that show nothing
    keep their places. Samples stay as they were measured: images are cut where they meet, neither blended nor
    brightened.
    """
    from rdstitch.pipeline.stage_tiles import place_tiles
    from rdstitch.pipeline.stage_tiles import tiles as recipe

    if output is None and positions_only is None:
        raise click.UsageError("nothing to write: give --output or --positions-only")
    beside = files_beside(given)
    if output is None and (as_json or given["dry_run"] or beside.report is not None):
        raise click.UsageError("--positions-only has neither --report, --json nor --dry-run without --output")
    paths = resolve(inputs)
    composite = replace(measured_samples(), **values_of(CompositeOptions, given))
    chosen = TileOptions(**values_of(TileOptions, given), composite=composite)
    if output is None:
        _, registration = place_tiles(paths, positions_only, chosen, progress=reporter)
        report_registration(registration, reporter)
        reporter.made(f"{positions_only}: {registration.summary}")
    else:
        result = recipe(paths, output, chosen, positions_file=positions_only, progress=reporter, beside=beside)
        registration = result.registration
        report_result(result, reporter, as_json=as_json)
    if not registration.ok:
        raise PartialResultError("most tiles have not been placed by what they show; what could be placed is written")
