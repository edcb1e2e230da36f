"""``rdstitch undistort``: straight lines become straight."""

from pathlib import Path
from typing import Annotated

import click

from rdstitch.choices import Framing, ImageFormat
from rdstitch.options.option import FileUse, Option
from rdstitch.options.shared_options import Distortion, Overwrite, Topic
from rdstitch.options.stitch_options import StitchOptions
from rdstitch_cli.flags import Inputs, command, flags_of
from rdstitch_cli.stitching import resolve
from rdstitch_cli.terminal import Reporter


@command(
    """
  rdstitch undistort frames/*.jpg --camera camera.json -o straight/
  rdstitch undistort wall.jpg --lambda -0.25 -o straight/
""",
    flags_of(StitchOptions, only="camera"),
)
def undistort(
    inputs: Inputs,
    camera: Path | None,
    output: Annotated[Path, Option("Folder to write to; made if missing.", "DIR", "-o --output", file=FileUse.WRITTEN)],
    view: Annotated[
        Framing, Option("Field of view: size and scale of the image, everything it shows, or without empty borders.")
    ] = "same",
    image_format: Annotated[
        ImageFormat | None,
        Option(
            "Format of the files written; otherwise that of each image, or png where it cannot be written.",
            flag="--format",
        ),
    ] = None,
    distortion: Distortion = None,
    overwrite: Overwrite = False,
    topic: Topic = None,
    *,
    reporter: Reporter,
) -> None:
    """Undistort images with a known lens, each into a file of the same name in a folder.

    INPUT is what 'rdstitch mosaic' takes. The lens comes from a camera file, as 'rdstitch pano --save-camera' and
    'rdstitch calibrate' write it, or is given as λ for half the image diagonal.
    """
    from rdstitch.pipeline.undistort_images import undistort as recipe

    if (camera is None) == (distortion is None):
        raise click.UsageError("give either --camera FILE or --lambda L")
    written = recipe(
        resolve(inputs),
        output,
        camera=camera,
        distortion=distortion,
        view=view,
        image_format=image_format,
        overwrite=overwrite,
        topic=topic,
        warn=reporter.tell,
        progress=reporter,
    )
    reporter.finish()
    noun = "image" if len(written) == 1 else "images"
    reporter.made(f"{output}: {len(written)} {noun} undistorted")
