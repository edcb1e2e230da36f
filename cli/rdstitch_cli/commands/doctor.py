"""``rdstitch doctor``: what will happen, before a long run."""

from pathlib import Path

import click

from rdstitch_cli import options
from rdstitch_cli.help_pages import command
from rdstitch_cli.terminal import Reporter


@command(
    "What to expect of a run, and what to change before it.",
    """
  rdstitch doctor flight/
  rdstitch doctor drive.mp4 --json
""",
)
@options.inputs
@options.every
@options.topic
@options.as_json("what was found")
@options.verbosity
def doctor(inputs: tuple[Path, ...], every: int | None, topic: str | None, as_json: bool, reporter: Reporter) -> None:
    """Find out what a run will meet, and what to change before it.

    INPUT is what 'rdstitch mosaic' takes. Shown are sizes, cameras and zooms by EXIF, blur, exposure, and, by a dry run
    on small versions of the images, overlap, size of the mosaic, and memory and time of compositing it. Nothing is
    written.
    """
    from rdstitch.pipeline.doctor import examine
    from rdstitch.system.outputs import json_bytes

    examination = examine(options.resolve(inputs), every=every, topic=topic, progress=reporter)
    reporter.finish()
    if as_json:
        click.echo(json_bytes(examination.as_dict()), nl=False)
    else:
        click.echo(examination.as_text(), nl=False)
