"""Help pages: options in groups, those that matter first on top; ``rdstitch help``."""

import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import click

# The layout of the pages: groups and options in their order, those of the first page with a star.
_PAGE = """
Options that matter first: *output *overwrite *images *preview *reference *camera *focal *mask *scale *report format
    frame *height *view *quiet
Places: *grid columns order origin *overlap *positions positions-offset position-accuracy gcp check-points
    *positions-only *pixel-size *search
Tiles: *channel *z time *flat-field *save-flat-field
Input: *follow idle refresh *every *exclude include-only match topic timestamps odometry
Camera: *lambda lens tilt attitude attitude-std save-camera camera-format
Features and registration: features aliked-model lightglue-model max-features work-megapixels solver model threshold
Output: *gsd crs like extent georeference north-up rotate straighten rectangle level yaw pitch roll *crop projection
    max-stretch *max-size local-alignment *exposure seam blend interpolation background quality layers whole-layers
    bands all-blocks poses hugin-project map-server plot json
Control: strict force dry-run *cache max-memory *workers scheduler seed verbose *config *help *help-all
"""
_PLACES = {
    f"--{name.lstrip('*')}": (group, rank, name.startswith("*"))
    for group, _, names in (line.partition(": ") for line in _PAGE.strip().replace("\n    ", " ").splitlines())
    for rank, name in enumerate(names.split())
}
_LAST = ("Control", len(_PLACES), False)  # where an option is shown that the page does not name

EXIT_STATUSES = """\b
Exit status:
  0    done; images left out are named on standard error
  1    unexpected failure
  2    wrong usage
  3    a file cannot be read
  4    no overlap, or no reliable result
  5    partial result under --strict, or most tiles keep the stage's own places
  6    output cannot be written, or exists (see --overwrite)
  7    refused: too large for memory, format or common sense
  130  interrupted; 143 when asked to end by SIGTERM, 129 by SIGHUP
  141  nobody reads standard output any more; the files are written
"""

_FEW = 25  # options that are shown all at once
_ALL = "rdstitch_cli.help_all"


def _show_all(context: click.Context, _option: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        context.meta[_ALL] = True
        click.echo(context.get_help())
        context.exit()


class GroupedCommand(click.Command):
    """A command whose page shows its options in groups; of many those that matter, and all with ``--help-all``."""

    def __init__(self, *arguments: Any, **given: Any) -> None:
        super().__init__(*arguments, **given)
        self.has_many = len(self.params) > _FEW
        how: dict[str, Any] = {"is_flag": True, "is_eager": True, "expose_value": False, "callback": _show_all}
        self.params.append(click.Option(["--help-all"], **how, help="Show all options."))

    def format_options(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the groups in their order, each with the options that this command has of it."""
        rows: dict[str, dict[int, tuple[str, str]]] = {group: {} for group, _, _ in _PLACES.values()}
        brief = self.has_many and not context.meta.get(_ALL)
        left = 0
        for parameter in self.get_params(context):
            record = parameter.get_help_record(context)
            if record is not None and isinstance(parameter, click.Option):
                group, rank, first = _PLACES.get(max(parameter.opts, key=len), _LAST)
                if first or not brief:
                    rows[group][rank] = record
                else:
                    left += 1
        for group, records in rows.items():
            if records:
                with formatter.section(group):
                    formatter.write_dl([record for _, record in sorted(records.items())])
        if left:
            formatter.write_paragraph()
            formatter.write_text(f"{left} more options: {context.command_path} --help-all")


@click.command(
    "help",
    cls=GroupedCommand,
    epilog="\b\nExamples:\n  rdstitch help\n  rdstitch help pano\n  rdstitch help no-overlap\n",
)
@click.argument("topics", nargs=-1, metavar="[COMMAND|CODE]")
@click.pass_context
def help_command(context: click.Context, topics: Sequence[str]) -> None:
    """Show the help of a command, what the code of a message means, or this page."""
    root = context.find_root()
    group = root.command
    assert isinstance(group, click.Group)
    if not topics:
        click.echo(group.get_help(root))
        return
    name = " ".join(topics)
    if command := group.get_command(root, name):
        click.echo(command.get_help(click.Context(command, info_name=name, parent=root)))
    elif paragraph := troubleshooting().get(name.strip("[]")):
        click.echo(paragraph)
    else:
        raise click.UsageError(f"there is no command and no message code {name!r}", root)


def troubleshooting() -> dict[str, str]:
    """What to do about each message, by its code: the paragraphs of docs/troubleshooting.md."""
    page = resources.files("rdstitch_cli") / "troubleshooting.md"
    if not page.is_file():  # a checkout
        page = Path(__file__).parents[2] / "docs" / "troubleshooting.md"
    text = re.sub(r"\[([a-z-]+)\]\(#\1\)", r"`rdstitch help \1`", page.read_text(encoding="utf-8"))
    sections = re.split(r"^##+ ", text, flags=re.MULTILINE)[1:]
    titles = [section.partition("\n") for section in sections]
    return {title: body.strip() for title, _, body in titles if body.strip() and " " not in title}
