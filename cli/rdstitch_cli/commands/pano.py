"""``rdstitch pano``: a few overlapping images become one."""

from pathlib import Path
from typing import Any

from rdstitch_cli import options
from rdstitch_cli.help_pages import command
from rdstitch_cli.stitching import files_beside, stitch_options, summarize
from rdstitch_cli.terminal import Reporter


@command(
    "One image of a few that overlap.",
    """
  rdstitch pano left.jpg right.jpg -o pano.jpg
  rdstitch pano *.png -o wall.png --reference middle.png --report wall.html
  rdstitch pano a.jpg b.jpg -o ab.tif --camera camera.json
""",
)
@options.inputs
@options.stitching
@options.every
@options.topic
def pano(
    inputs: tuple[Path, ...],
    output: Path,
    every: int | None,
    as_json: bool,
    reporter: Reporter,
    **given: Any,
) -> None:
    """Stitch two or more images that overlap, in any order.

    INPUT is what 'rdstitch mosaic' takes, but every image must be readable. The image goes to the output,
    everything estimated to the output's name with .json added, and λ to standard output.
    """
    from rdstitch.pipeline.recipes import pano as recipe

    paths = options.resolve(inputs)
    beside = files_beside(reporter, given)
    stitch = stitch_options(reporter, **given)
    result = recipe(paths, output, stitch, every=every, progress=beside.timer, beside=beside)
    summarize(result, reporter, as_json=as_json)
    if result.plan is None:
        reporter.made(result.summary)
