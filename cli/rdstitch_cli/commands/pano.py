"""``rdstitch pano``: a few overlapping images become one."""

from typing import Any

from rdstitch.options.files_beside import ImageFiles
from rdstitch.options.shared_options import Every
from rdstitch_cli.flags import ImageFile, Inputs, PrintSidecar, command, flags_of
from rdstitch_cli.stitching import STITCHING, Preview, files_beside, report_result, resolve, stitch_options
from rdstitch_cli.terminal import Reporter


@command(
    """
  rdstitch pano left.jpg right.jpg -o pano.jpg
  rdstitch pano *.png -o wall.png --reference middle.png --report wall.html
  rdstitch pano a.jpg b.jpg -o ab.tif --camera camera.json
""",
    STITCHING,
    flags_of(ImageFiles),
)
def pano(
    inputs: Inputs,
    output: ImageFile,
    every: Every = None,
    preview: Preview = False,
    as_json: PrintSidecar = False,
    *,
    reporter: Reporter,
    **given: Any,
) -> None:
    """Stitch two or more images that overlap, in any order.

    INPUT is what 'rdstitch mosaic' takes, but every image must be readable. The image goes to the output,
    everything estimated to the output's name with .json added, and λ to standard output.
    """
    from rdstitch.pipeline.recipes import pano as recipe

    beside, options = files_beside(given), stitch_options(given, preview=preview)
    result = recipe(resolve(inputs), output, options, every=every, progress=reporter, beside=beside)
    report_result(result, reporter, as_json=as_json)
