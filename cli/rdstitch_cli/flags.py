"""The command line of declared options: flags, their types and limits, defaults and help follow from annotations."""

import inspect
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, ForwardRef, get_args, get_origin

import click
from click.core import ParameterSource

from rdstitch.errors import ArgumentError
from rdstitch.options.option import Declared, FileUse, Option, Unit, declaration, declared
from rdstitch_cli.config import CONFIG_FILE, config
from rdstitch_cli.help_pages import EXIT_STATUSES, GroupedCommand
from rdstitch_cli.terminal import Reporter

Inputs = Annotated[tuple[Path, ...], "INPUT..."]  # an argument rather than an option
ImageFile = Annotated[
    Path, Option("Image to write: .jpg, .png, .tif, .webp or .dzi.", flag="-o --output", file=FileUse.WRITTEN)
]
PrintSidecar = Annotated[bool, Option("Print the sidecar as JSON.", flag="--json")]
_GOES_ON = "the same command goes on from the cache"  # note at an interrupt


def command(examples: str, *options: Iterable[click.Option]) -> Callable[[Callable[..., Any]], click.Command]:
    """A command of a function: flags of its parameters and of the options given, whose values arrive as ``**given``."""

    def make(function: Callable[..., Any]) -> click.Command:
        @wraps(function)
        def run(*, quiet: bool, verbose: bool, **given: Any) -> Any:
            _check_needs(flags, given)
            # Of the configuration, over which nothing may be written, the library knows nothing.
            if configuration := click.get_current_context().meta.get(CONFIG_FILE):
                from rdstitch.system.output_checks import check_not_read

                written = [given[str(flag.name)] for flag in flags if flag.declared.file is FileUse.WRITTEN]
                check_not_read([path for path in written if path is not None], [configuration])
            try:
                with Reporter(verbose - quiet) as reporter:
                    return function(reporter=reporter, **given)
            except BaseException as error:
                if given.get("cache") is not None:
                    error.add_note(_GOES_ON)
                raise

        parameters: list[click.Parameter] = []
        for name, parameter in inspect.signature(function).parameters.items():
            if option := declaration(name, parameter.annotation):
                parameters.append(_flag(option, parameter.default))
            elif metavar := getattr(parameter.annotation, "__metadata__", None):
                many = -1 if metavar[0].endswith("...") else 1
                kind = FilePath(allow_dash=many < 0)
                parameters.append(click.Argument([name], nargs=many, required=True, type=kind, metavar=metavar[0]))
        parameters += [option for group in options for option in group]
        parameters += [
            click.Option(["-q", "--quiet"], is_flag=True, help="Print errors only."),
            click.Option(["-v", "--verbose"], is_flag=True, help="Print details."),
            config,
        ]
        flags = [option for option in parameters if isinstance(option, Flag)]
        epilog = f"\b\nExamples:{examples}\n\n{EXIT_STATUSES}"
        return GroupedCommand(function.__name__, callback=run, params=parameters, help=function.__doc__, epilog=epilog)

    return make


def flags_of(options: Any, *, only: str = "", without: str = "") -> list[click.Option]:
    """Flags of the options of a class, or of an object whose values are the defaults; all, or those of some names."""
    chosen = [option for option in declared(options).values() if option.option.flag is not None]
    if only:
        chosen = [option for option in chosen if option.name in only.split()]
    return [_flag(o, getattr(options, o.name)) for o in chosen if o.name not in without.split()]


def values_of(kind: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a class among those that a command was given."""
    flags = (name for name, each in declared(kind).items() if each.option.flag is not None)
    return {name: given[name] for name in flags if name in given}


def is_given(name: str) -> bool:
    """Check whether the user set an option of the running command, rather than left it at its default."""
    return click.get_current_context().get_parameter_source(name) not in (None, ParameterSource.DEFAULT)


def _check_needs(flags: Sequence["Flag"], given: Mapping[str, Any]) -> None:
    """Refuse an option of the command line that means nothing without others; in a configuration it may stand."""
    context = click.get_current_context()
    for flag in flags:
        needed = [other for other in flags if other.name in flag.declared.needs]
        stated = context.get_parameter_source(str(flag.name)) is ParameterSource.COMMANDLINE
        if stated and needed and not any(given[str(other.name)] for other in needed):
            goes_with = " or ".join(max(other.opts, key=len) for other in needed)
            raise click.UsageError(f"{max(flag.opts, key=len)} goes with {goes_with}")


def _flag(entry: Declared, default: Any) -> click.Option:
    option = entry.option
    names = [*(option.flag or f"--{entry.name.replace('_', '-')}").split(), entry.name]
    how: dict[str, Any] = {"required": True} if default is inspect.Parameter.empty else {"default": default}
    plain = "" if _is_unset(default) else str(default)
    names_file = Path in entry.types or any(isinstance(kind, ForwardRef) for kind in entry.types)
    kind = Path if names_file else entry.types[0] if entry.types else None
    how |= _KINDS.get(kind, _entered)(entry, default)
    shown = how.pop("shown", plain)
    text = option.in_unit(Unit.DEGREES) + f"  [default: {shown}]" * bool(shown)
    return Flag(names, metavar=option.metavar or None, help=text, declared=option, **how)


def _is_unset(default: Any) -> bool:
    """Whether there is nothing to show of a default."""
    return default is None or default is False or default == () or default is inspect.Parameter.empty


def _of_words(entry: Declared, default: Any) -> dict[str, Any]:
    """One of some words; of two that a switch stands for, by the switch."""
    if "/" in (entry.option.flag or ""):
        off, on = entry.words
        chosen = {"callback": lambda _c, _o, value: on if value else off, "shown": ""}
        return {"is_flag": True, "default": default == on, **chosen}
    by_flag = {word.replace("_", "-"): word for word in entry.words}
    return {"type": click.Choice([*by_flag]), "callback": lambda _c, _o, value: by_flag.get(value, value)}


def _entered(entry: Declared, default: Any) -> dict[str, Any]:
    """Numbers, or a word."""
    value = EnteredValue(entry)
    return {"type": value, "shown": value.shown(default)}


_KINDS: dict[Any, Callable[[Declared, Any], dict[str, Any]]] = {
    None: _of_words,
    bool: lambda _entry, _default: {"is_flag": True, "shown": ""},
    str: lambda _entry, _default: {"type": str},
    Path: lambda entry, _default: {"type": FilePath(entry.words)},
    tuple[str, ...]: lambda _entry, _default: {"multiple": True, "type": str},
    tuple[Path, ...]: lambda _entry, _default: {"multiple": True, "type": FilePath()},
}
"""What click is told of an option, by its type; of all others, whose values are numbers, :func:`_entered`."""


class Flag(click.Option):
    """An option with what is declared of it."""

    def __init__(self, *arguments: Any, declared: Option, **given: Any) -> None:
        super().__init__(*arguments, **given)
        self.declared = declared


class FilePath(click.Path):
    """A file or folder, which the library checks, or a word that stands for something else; ``./word`` is a file."""

    def __init__(self, words: Sequence[str] = (), *, allow_dash: bool = False) -> None:
        super().__init__(path_type=Path, readable=False, allow_dash=allow_dash)
        self.words = words

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Replace ``~``, also where no shell has; an address stays text: as a path it would lose one of its slashes."""
        if value == "":  # as a path it would be the current folder
            self.fail("a name is empty; was a variable of the shell not set?", param, ctx)
        if value in self.words or "://" in str(value):
            return value
        path = super().convert(value, param, ctx)
        try:
            return path.expanduser() if isinstance(path, Path) else path
        except RuntimeError:  # there is no such user
            return path


class EnteredValue(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    """Numbers, within their limits, or a word."""

    name = "N"

    def __init__(self, entry: Declared) -> None:
        option = entry.option
        if option.unit is Unit.RADIANS:
            option = replace(option, unit=Unit.DEGREES, within=option.within.in_degrees)
        self.entry = replace(entry, option=option)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The value of a text."""
        if not isinstance(value, str) or value in self.entry.words:
            return value
        if value and value == self.entry.option.none:
            return None
        for kind in self.entry.types:
            with suppress(ValueError, OverflowError, ArgumentError):
                parsed = self.entry.taken(self._parsed(value, kind))
                return self._in_radians(parsed) if self.entry.option.unit is Unit.DEGREES else parsed
        expected = self.entry.expected
        if self.entry.option.unit is Unit.BYTES:
            expected = "an amount of memory such as 800M or 2G"
        elif self.entry.option.none:
            expected = f"{self.entry.option.none} or {expected}"
        return self.fail(f"expected {expected}, not {value!r}", param, ctx)

    def shown(self, value: Any) -> str:
        """A default, as one would enter it; empty where there is none."""
        if _is_unset(value):
            return self.entry.option.none if value is None else ""
        if self.entry.option.unit is Unit.DEGREES:
            value = math.degrees(value)
        return f"{value:g}" if isinstance(value, int | float) else str(value)

    def _parsed(self, text: str, kind: Any) -> Any:
        if get_origin(kind) is tuple:
            inner = get_args(kind)[0]
            return tuple(self._parsed(part, inner) for part in text.split(";" if get_origin(inner) is tuple else ","))
        if self.entry.option.unit is Unit.BYTES:
            parts = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([KMGT]?)(?:i?B)?\s*", text, re.IGNORECASE)
            return int(float(parts[1]) * 2 ** (10 * " KMGT".index(parts[2].upper() or " "))) if parts else 0
        prefix, colon, _ = self.entry.option.metavar.rpartition(":")  # EPSG:
        return kind(text.upper().removeprefix(prefix + colon))

    def _in_radians(self, degrees: Any) -> Any:
        return tuple(map(math.radians, degrees)) if isinstance(degrees, tuple) else math.radians(degrees)
