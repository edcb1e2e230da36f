"""``--config FILE.toml``: defaults of options, for all commands and for single ones; flags win."""

import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import click

from rdstitch.errors import InputError

COMMON = "common"  # the table that holds for every command
CONFIG_FILE = "rdstitch_cli.config"  # key of the file in the context's meta


def read_config(path: Path, commands: Mapping[str, click.Command], running: str) -> dict[str, Any]:
    """The defaults that a file gives a command, by parameter name; all tables are checked."""
    tables = _parse(path)
    known = {name: _options(command) for name, command in commands.items()}
    # Options of one name may take other values in other commands: those of the running one hold.
    known[COMMON] = {key: option for options in known.values() for key, option in options.items()} | known[running]
    defaults: dict[str, Any] = {}
    for table in sorted(tables, key=lambda name: name != COMMON):  # the command's own table wins
        if not isinstance(tables[table], dict):
            raise InputError(f"{path}: {table}: options belong into a table, such as [{COMMON}] or [{running}]")
        if table not in known:
            raise InputError(f"{path}: there is no command {table!r}{_suggestion(table, known)}")
        for key, value in tables[table].items():
            if key not in known[table]:
                raise InputError(f"{path}: {table}.{key}: there is no such option{_suggestion(key, known[table])}")
            if table == COMMON and key not in known[running]:
                continue
            option = known[table][key]
            converted = _converted(option, value, f"{path}: {table}.{key}")
            if table in (COMMON, running) and option.name is not None:
                defaults[option.name] = converted
    return defaults


def _parse(path: Path) -> dict[str, Any]:
    from rdstitch.system.file_access import read_text

    try:
        return tomllib.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not TOML: {error}") from error


def _options(command: click.Command) -> dict[str, click.Option]:
    """Options that a file may set, by their long names."""
    return {
        max(option.opts, key=len).lstrip("-"): option
        for option in command.params
        if isinstance(option, click.Option) and option.expose_value
    }


def _converted(option: click.Option, value: Any, where: str) -> Any:
    """The value as the command line would have it; it goes through the option's checks, which here name the place."""
    texts = value if option.multiple else [value]
    kinds = (bool,) if option.is_flag else (str,) if option.multiple else (str, int, float)
    if not isinstance(texts, list) or any(type(text) not in kinds for text in texts):
        expected = "true or false" if option.is_flag else "a list of texts" if option.multiple else "a text or a number"
        raise InputError(f"{where}: expected {expected}, not {value!r}")
    converted = value if option.is_flag or option.multiple else str(value)
    try:
        option.type_cast_value(click.Context(click.Command("config")), converted)
    except (click.BadParameter, ValueError, OverflowError) as error:
        problem = error.message if isinstance(error, click.BadParameter) else error
        raise InputError(f"{where}: {problem}") from error
    return converted


def _suggestion(name: str, known: Iterable[str]) -> str:
    from difflib import get_close_matches

    close = get_close_matches(name.replace("_", "-"), list(known), n=1)
    return f"; do you mean {close[0]!r}?" if close else ""


def _apply(context: click.Context, option: click.Parameter, path: Path | None) -> None:
    """Make the values of the file the defaults of the running command."""
    group = context.find_root().command
    if path is None or context.resilient_parsing or not isinstance(group, click.Group):
        return
    commands = {name: command for name in group.list_commands(context) if (command := group.get_command(context, name))}
    context.meta[CONFIG_FILE] = path
    context.default_map = read_config(path, commands, str(context.command.name))


config = click.Option(
    ["--config"],
    type=click.Path(path_type=Path, readable=False),
    metavar="FILE",
    is_eager=True,  # it sets defaults before any other option is looked at
    expose_value=False,
    callback=_apply,
    help="Read options from this TOML file; the command line takes precedence. Relative paths in it are from the "
    "current folder.",
)
