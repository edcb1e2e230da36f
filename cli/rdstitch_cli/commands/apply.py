"""``rdstitch apply``: compose again by a registration that was saved."""

from pathlib import Path
from typing import Annotated, Any

from rdstitch.options.apply_options import ApplyOptions
from rdstitch.options.composite_options import CompositeOptions
from rdstitch.options.option import Option
from rdstitch_cli.flags import ImageFile, command, flags_of, is_given, values_of
from rdstitch_cli.stitching import report_applied, resolve
from rdstitch_cli.terminal import Reporter


@command(
    """
  rdstitch apply field.tif.json --images flight/ -o field_again.tif --blend feather
  rdstitch apply field_red.tif.json --images flight_nir/ -o field_nir.tif
  rdstitch apply small.jpg.json --images originals/ -o large.tif --match name --strict
""",
    flags_of(CompositeOptions),
    flags_of(ApplyOptions),
)
def apply(
    sidecar: Annotated[Path, "SIDECAR"],
    images: Annotated[
        tuple[Path, ...],
        Option("Images to compose: what 'rdstitch mosaic' takes; may be given several times.", "INPUT"),
    ],
    output: ImageFile,
    *,
    reporter: Reporter,
    **given: Any,
) -> None:
    """Compose images by the registration in a sidecar, without estimating anything.

    The images are those that the sidecar was made from, or others taken by the same lens from the same places:
    another band of the same flight, the originals of reduced images, masks. They may have another size of the same
    shape. Compositing options that are not given are those of the sidecar.
    """
    from rdstitch.pipeline.apply_sidecar import apply as recipe

    compositing = values_of(CompositeOptions, given)
    chosen = {name: value for name, value in compositing.items() if is_given(name)}
    options = ApplyOptions(**values_of(ApplyOptions, given))
    result = recipe(sidecar, resolve(images), output, options=options, progress=reporter, **chosen)
    report_applied(result, reporter)
