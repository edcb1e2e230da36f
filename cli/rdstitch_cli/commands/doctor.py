"""``rdstitch doctor``: what will happen, before a long run."""

from typing import Annotated

import click

from rdstitch.options.option import Option
from rdstitch.options.shared_options import Every, Topic
from rdstitch_cli.flags import Inputs, command
from rdstitch_cli.stitching import resolve
from rdstitch_cli.terminal import Reporter


@command(
    """
  rdstitch doctor flight/
  rdstitch doctor drive.mp4 --json
"""
)
def doctor(
    inputs: Inputs,
    every: Every = None,
    topic: Topic = None,
    as_json: Annotated[bool, Option("Print what was found as JSON.", flag="--json")] = False,
    *,
    reporter: Reporter,
) -> None:
    """Find out what a run will meet, and what to change before it.

    INPUT is what 'rdstitch mosaic' takes. Shown are sizes, cameras and zooms by EXIF, blur, exposure, and, by a dry run
    on small versions of the images, overlap, size of the mosaic, and memory and time of compositing it. Nothing is
    written.
    """
    from rdstitch.pipeline.doctor import examine
    from rdstitch.system.outputs import json_bytes

    examination = examine(resolve(inputs), every=every, topic=topic, progress=reporter)
    reporter.finish()
    if as_json:
        click.echo(json_bytes(examination.as_dict()), nl=False)
    else:
        click.echo(examination.as_text(), nl=False)
