"""``rdstitch doctor``: what will happen, before a long run."""

from pathlib import Path

import click

from rdstitch_cli import options
from rdstitch_cli.help_pages import GroupedCommand
from rdstitch_cli.terminal import Reporter


@click.command(
    cls=GroupedCommand,
    epilog="""\b
Examples:
  rdstitch doctor flight/
  rdstitch doctor drive.mp4 --json
""",
)
@options.inputs
@options.every
@options.as_json
@options.verbosity
def doctor(inputs: tuple[Path, ...], every: int | None, as_json: bool, reporter: Reporter) -> None:
    """Find out at a glance what a run will meet, and what to change before it.

    INPUT is what 'rdstitch mosaic' takes. Shown are sizes, cameras and zooms by EXIF, blur, exposure, overlap, and the
    memory and time to expect. It says what is likely; nothing is registered or written.
    """
    from rdstitch.doctor import examine
    from rdstitch.io.atomic import json_bytes

    found = examine(options.resolve(inputs), every=every, progress=reporter)
    reporter.finish()
    if as_json:
        click.echo(json_bytes(found.as_dict()), nl=False)
    else:
        click.echo(found.as_text(), nl=False)
