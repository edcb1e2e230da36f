"""``rdstitch apply``: compose again by a registration that was saved."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import click

from rdstitch_cli import options
from rdstitch_cli.help_pages import command
from rdstitch_cli.option_texts import option
from rdstitch_cli.stitching import composite_fields, report_applied
from rdstitch_cli.terminal import Reporter


@command(
    "Compose again by a saved sidecar, without estimating.",
    """
  rdstitch apply field.tif.json --images flight/ -o field_again.tif --blend feather
  rdstitch apply field_red.tif.json --images flight_nir/ -o field_nir.tif
  rdstitch apply small.jpg.json --images originals/ -o large.tif --match name --strict
""",
)
@click.argument("sidecar", type=options.IMAGE, metavar="SIDECAR")
@option("--images", options.IMAGE, required=True, multiple=True)
@options.output
@options.overwrite
@options.every_frame
@options.topic
@option("--match", ("auto", "name", "order"), "auto")
@options.mask
@options.no_flat_field
@options.compositing
@options.workers
@options.strict
@options.verbosity
def apply(
    sidecar: Path,
    images: tuple[Path, ...],
    output: Path,
    match: Literal["auto", "name", "order"],
    reporter: Reporter,
    **given: Any,
) -> None:
    """Compose images by the registration in a sidecar, without estimating anything.

    The images are those that the sidecar was made from, or others taken by the same lens from the same places:
    another band of the same flight, the originals of reduced images, masks. They may have another size of the same
    shape. Compositing options that are not given are those of the sidecar.
    """
    from rdstitch.pipeline.apply_sidecar import apply as recipe
    from rdstitch.sidecar.read import read_sidecar

    chosen = {name: value for name, value in composite_fields(given).items() if options.is_given(name)}
    # What is given takes the place of what the sidecar has for the same purpose.
    if "scale" in chosen or "gsd" in chosen:
        chosen = {"scale": 1.0, "gsd": None, **chosen}
    if chosen.keys() & {"rectangle", "straighten", "level"}:
        chosen = {"rectangle": None, "straighten": "off", "level": False, **chosen}
    composite = replace(read_sidecar(sidecar).composite, **chosen)
    result = recipe(sidecar, options.resolve(images), output, composite, match=match, progress=reporter, **given)
    report_applied(result, reporter)
