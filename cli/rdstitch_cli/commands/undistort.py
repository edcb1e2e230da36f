"""``rdstitch undistort``: straight lines become straight."""

from pathlib import Path
from typing import Annotated, Any

import click

from rdstitch.options.option import FileUse, Option
from rdstitch.options.undistort_options import UndistortOptions
from rdstitch_cli.flags import Inputs, command, flags_of, values_of
from rdstitch_cli.stitching import resolve
from rdstitch_cli.terminal import Reporter


@command(
    """
  rdstitch undistort frames/*.jpg --camera camera.json -o straight/
  rdstitch undistort wall.jpg --lambda -0.25 -o straight/
""",
    flags_of(UndistortOptions),
)
def undistort(
    inputs: Inputs,
    output: Annotated[Path, Option("Folder to write to; made if missing.", "DIR", "-o --output", file=FileUse.WRITTEN)],
    *,
    reporter: Reporter,
    **given: Any,
) -> None:
    """Undistort images with a known lens, each into a file of the same name in a folder.

    INPUT is what 'rdstitch mosaic' takes. The lens comes from a camera file, as 'rdstitch pano --save-camera' and
    'rdstitch calibrate' write it, or is given as λ for half the image diagonal.
    """
    from rdstitch.pipeline.undistort_images import undistort as recipe

    options = UndistortOptions(**values_of(UndistortOptions, given))
    if (options.camera is None) == (options.distortion is None):
        raise click.UsageError("give either --camera FILE or --lambda L")
    written = recipe(resolve(inputs), output, options, warn=reporter.tell, progress=reporter)
    reporter.finish()
    noun = "image" if len(written) == 1 else "images"
    reporter.made(f"{output}: {len(written)} {noun} undistorted")
