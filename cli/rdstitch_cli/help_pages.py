"""Help pages: options in groups, those that matter first on top; ``rdstitch help``."""

import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import click

_FIRST = "Options that matter first"
_GROUPS = {
    _FIRST: (
        "output overwrite images preview reference camera focal mask scale report layout image_format frame height "
        "view quiet"
    ),
    "Places": "grid overlap positions positions_offset gcp positions_only pixel_size search",
    "Tiles": "channel flat_field save_flat_field",
    "Input": "following idle refresh every exclude include_only match topic timestamps",
    "Camera": "distortion lens tilt attitude attitude_std save_camera",
    "Features and registration": (
        "features aliked_model lightglue_model max_features work_megapixels solver model threshold"
    ),
    "Output": (
        "gsd epsg north_up rotate straighten rectangle level yaw pitch roll crop projection max_stretch max_size "
        "local_alignment exposure seam blend interpolation background quality layers whole_layers all_blocks poses "
        "hugin_project plot as_json"
    ),
    "Control": "strict force dry_run cache max_memory workers scheduler seed verbose config help help_all",
}
_OTHERS = "Other options"
_BRIEF = (
    "output overwrite images preview camera distortion focal mask exclude every following reference scale gsd crop "
    "max_size exposure report cache workers quiet config help help_all grid overlap positions positions_only "
    "pixel_size search channel flat_field save_flat_field"
)
_FEW = 25  # options that are shown all at once
_ALL = "rdstitch_cli.help_all"


def _show_all(context: click.Context, _option: click.Parameter, wanted: bool) -> None:
    """Print the page with all options, and end."""
    if wanted and not context.resilient_parsing:
        context.meta[_ALL] = True
        click.echo(context.get_help())
        context.exit()


class GroupedCommand(click.Command):
    """A command whose help page shows its options in groups; of many, first those that matter.

    ``--help-all`` shows all of them.
    """

    def __init__(self, *arguments: Any, **given: Any) -> None:
        super().__init__(*arguments, **given)
        if len(self.params) > _FEW:
            self.params.append(
                click.Option(
                    ["--help-all"],
                    is_flag=True,
                    is_eager=True,
                    expose_value=False,
                    callback=_show_all,
                    help="Show all options.",
                )
            )

    def format_options(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the groups in their order, each with the options that this command has of it."""
        rows: dict[str, list[tuple[int, tuple[str, str]]]] = {group: [] for group in (*_GROUPS, _OTHERS)}
        brief = any(parameter.name == "help_all" for parameter in self.params) and not context.meta.get(_ALL)
        left = 0
        for parameter in self.get_params(context):
            record = parameter.get_help_record(context)
            if record is not None and isinstance(parameter, click.Option):
                name = "help" if "--help" in parameter.opts else parameter.name or ""
                group, rank = place_of(name)
                if not brief or name in _BRIEF.split():
                    rows[group].append((rank, record))
                else:
                    left += 1
        for group, found in rows.items():
            if found:
                with formatter.section(group):
                    formatter.write_dl([record for _, record in sorted(found)])
        if left:
            formatter.write_paragraph()
            formatter.write_text(f"{left} more options: {context.command_path} --help-all")


def place_of(name: str) -> tuple[str, int]:
    """The group of an option, and its rank there."""
    for group, names in _GROUPS.items():
        if name in names.split():
            return group, names.split().index(name)
    return _OTHERS, 0


@click.command(
    "help",
    short_help="Help on a command, or on the code of a message.",
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
