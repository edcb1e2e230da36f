"""``rdstitch undistort``: straight lines become straight."""

from pathlib import Path
from typing import Any

import click

from rdstitch_cli import options
from rdstitch_cli.help_pages import command
from rdstitch_cli.option_texts import option
from rdstitch_cli.stitching import read_lens
from rdstitch_cli.terminal import Reporter


@command(
    "Images with straight lines straight, by a known lens.",
    """
  rdstitch undistort frames/*.jpg --camera camera.json -o straight/
  rdstitch undistort wall.jpg --lambda -0.25 -o straight/
""",
)
@options.inputs
@options.lens
@option("-o --output", options.IMAGE, of="undistort", required=True)
@options.overwrite
@options.topic
@option("--view", ("same", "all", "valid"), "same")
@option("--format", ("jpg", "png", "tif", "webp"), of="undistort", dest="image_format")
@options.verbosity
def undistort(inputs: tuple[Path, ...], camera: Path | None, output: Path, reporter: Reporter, **given: Any) -> None:
    """Undistort images with a known lens, each into a file of the same name in a folder.

    INPUT is what 'rdstitch mosaic' takes. The lens comes from a camera file, as 'rdstitch pano --save-camera' and
    'rdstitch calibrate' write it, or is given as λ for half the image diagonal.
    """
    from rdstitch.pipeline.undistort_images import undistort as recipe

    if (camera is None) == (given["distortion"] is None):
        raise click.UsageError("give either --camera FILE or --lambda L")
    lens, paths = read_lens(camera, reporter), options.resolve(inputs)
    written = recipe(paths, output, camera=lens, warn=reporter.tell, progress=reporter, **given)
    reporter.finish()
    noun = "image" if len(written) == 1 else "images"
    reporter.made(f"{output}: {len(written)} {noun} undistorted")
