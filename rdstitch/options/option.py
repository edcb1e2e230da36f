"""An option is declared once, as an annotated field: ``gsd: float = option(1.0, "Metres a pixel.", "M")``.

Of one that stands in several classes, or is a parameter, the type says it: ``Annotated[float, Option("Metres.")]``.
From this its value is checked, the documentation of its class is made, and the command line with its help. Nothing
large is imported here or by the modules of the options, so that ``--help`` is quick.
"""

import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from enum import Enum, StrEnum, auto
from inspect import isclass
from itertools import chain
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, ForwardRef, Literal, TypeVar, Union, get_args, get_origin

from rdstitch.errors import ArgumentError

Class = TypeVar("Class", bound=type)
AnyOptions = TypeVar("AnyOptions", bound="Options")


class FileUse(Enum):
    """What is done with the file or folder that an option names."""

    READ = auto()
    WRITTEN = auto()


class Unit(StrEnum):
    """Units of numbers that the command line takes in another form: angles in degrees, bytes as 800M."""

    RADIANS = auto()
    DEGREES = auto()
    BYTES = auto()


@dataclass(frozen=True)
class Range:
    """Limits of a number."""

    least: float = -math.inf
    above: float = -math.inf
    most: float = math.inf
    below: float = math.inf

    def __contains__(self, number: float) -> bool:
        return self.least <= number <= self.most and self.above < number < self.below and math.isfinite(number)

    def __str__(self) -> str:
        if math.isfinite(self.least) and math.isfinite(self.most):
            return f" from {_number(self.least)} to {_number(self.most)}"
        limits = {"of at least": self.least, "above": self.above, "of at most": self.most, "below": self.below}
        return " and".join(f" {words} {_number(value)}" for words, value in limits.items() if math.isfinite(value))

    @property
    def in_degrees(self) -> "Range":
        """The same limits of an angle in degrees."""
        return Range(*map(math.degrees, (self.least, self.above, self.most, self.below)))


@dataclass(frozen=True)
class Option:
    """What is said of an option besides its type and its default."""

    text: str  # {unit} in it stands for "radians" in Python, and for "degrees" on the command line
    metavar: str = ""  # what help pages call the value; empty: by its type
    # as "-j --workers" or "--crop/--no-crop"; empty: by the name of the field; None: not on the command line
    flag: str | None = ""
    within: Range = Range()  # limits of every number in it
    unit: Unit | None = None
    none: str = ""  # the word for None on the command line
    file: FileUse | None = None
    needs: tuple[str, ...] = ()  # names of options; without any of them it means nothing

    def in_unit(self, unit: Unit | None) -> str:
        """The text, of angles in a unit."""
        return self.text.replace("{unit}", unit or "")


def _number(value: float) -> str:
    """All digits of a whole number."""
    return f"{value:.0f}" if float(value).is_integer() else f"{value:g}"


def option(value: Any, text: str, metavar: str = "", flag: str | None = "", **more: Any) -> Any:
    """A field of a dataclass: its default, and what :class:`Option` says of it."""
    return field(default=value, metadata={"option": Option(text, metavar, flag, **more)})


def reads(text: str, metavar: str = "FILE") -> Any:
    """A field that names a file or folder that is read, if any."""
    return option(None, text, metavar, file=FileUse.READ)


def writes(text: str, metavar: str = "FILE") -> Any:
    """A field that names a file or folder that is written, if any."""
    return option(None, text, metavar, file=FileUse.WRITTEN)


@dataclass(frozen=True)
class Declared:
    """An option with its name and type: one of some words, a value of other types, or None."""

    name: str
    option: Option
    words: tuple[str, ...]
    types: tuple[Any, ...]
    optional: bool

    @property
    def expected(self) -> str:
        """What it may be, in words."""
        words = [f"one of {', '.join(self.words)}"] if len(self.words) > 2 else list(self.words)
        return " or ".join([*words, *(_in_words(kind, self.option) for kind in self.types)])

    def names_read(self, value: Any) -> bool:
        """Whether a value names a file or folder that is read."""
        return self.option.file is FileUse.READ and isinstance(value, str | PathLike) and value not in self.words

    def taken(self, value: Any) -> Any:
        """The value, of Python's own numbers and tuples; of texts and files only that they are none of another type.

        ArgumentError where it may not have it.
        """
        if (value is None and self.optional) or (isinstance(value, str) and value in self.words):
            return value
        nameless = isinstance(value, str) and not value and self.option.file is not None  # not the current folder
        for kind in self.types if value is not None and not nameless else ():
            with suppress(TypeError, ValueError):
                return _taken(value, kind, self.option)
        raise ArgumentError(f"{self.name} must be {self.expected}, not {value!r}")


def declaration(name: str, annotation: Any) -> Declared | None:
    """The option of an annotated field or parameter, if it is one."""
    option = next((item for item in getattr(annotation, "__metadata__", ()) if isinstance(item, Option)), None)
    if option is None:
        return None
    members = _members(get_args(annotation)[0])
    words = [word for member in members if get_origin(member) is Literal for word in get_args(member)]
    types = [member for member in members if get_origin(member) is not Literal and member is not NoneType]
    optional = any(member is NoneType or isinstance(member, ForwardRef) for member in members)
    return Declared(name, option, tuple(words), tuple(types), optional)


def declared(kind: Any) -> dict[str, Declared]:
    """The options among the fields of a dataclass."""
    annotated = {each.name: (each.type, each.metadata.get("option")) for each in fields(kind)}
    types = {name: kind if known is None else Annotated[kind, known] for name, (kind, known) in annotated.items()}
    return {name: found for name, kind in types.items() if (found := declaration(name, kind)) is not None}


@dataclass(frozen=True)
class Contradiction:
    """Options none of which may be given together with one of others, and why not."""

    names: tuple[str, ...]
    others: tuple[str, ...]
    reason: str

    def against(self, name: str) -> tuple[str, ...]:
        """Those that may not be given together with one."""
        return self.others if name in self.names else self.names if name in self.others else ()


class Options:
    """Base of classes of options, which are dataclasses; text that names a file becomes a path, arrays tuples."""

    __dataclass_fields__: ClassVar[dict[str, Any]]
    contradictions: ClassVar[tuple[Contradiction, ...]] = ()

    def __post_init__(self) -> None:
        """Refuse a value that its field may not have, and what contradicts another one."""
        for name, option in declared(self).items():
            value = getattr(self, name)
            if isinstance(value, str) and value and option.types == (Path,):
                value = Path(value)
            object.__setattr__(self, name, option.taken(value))
        for each in fields(self):
            kind: Any = each.default_factory
            if isclass(kind) and issubclass(kind, Options):
                options_of(kind, getattr(self, each.name), each.name)
        for contradiction in self.contradictions:
            if all(any(map(self._is_given, side)) for side in (contradiction.names, contradiction.others)):
                raise ArgumentError(contradiction.reason)

    def _is_given(self, name: str) -> bool:
        value, default = getattr(self, name), self.__dataclass_fields__[name].default
        return value is not None if default is None else bool(value != default)  # of an array, no truth is asked

    def agrees(self, other: "Options", kind: type["Options"]) -> bool:
        """Whether other options have the same values of all fields of a class that both are of."""
        return all(getattr(self, each.name) == getattr(other, each.name) for each in fields(kind))

    @property
    def files(self) -> list[Path]:
        """The files that are read besides the images, none of which may be written over."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        named = [values[name] for name, each in declared(self).items() if each.names_read(values[name])]
        within = [options.files for options in values.values() if isinstance(options, Options)]
        return [*files_in(*named), *chain(*within)]


def options_of(kind: type[AnyOptions], given: AnyOptions | None, name: str = "options") -> AnyOptions:
    """The options given, or the defaults; what is none of a kind is refused."""
    if given is None:
        return kind()
    if not isinstance(given, kind):
        raise ArgumentError(f"{name} must be {kind.__name__}, not {given!r}")
    return given


def files_in(*named: str | Path | None) -> list[Path]:
    """The files of these names; of folders, those in them."""
    given = [Path(name) for name in named if name is not None]
    return [file for path in given for file in (sorted(path.iterdir()) if path.is_dir() else [path])]


def with_fields(options: AnyOptions, given: dict[str, Any], others: Iterable[str] = ()) -> AnyOptions:
    """The same options with other values; a name that is none of theirs is refused, ``others`` may be what is meant."""
    known = [each.name for each in fields(options)]
    for name in given.keys() - set(known):
        from difflib import get_close_matches

        close = "".join(f"; do you mean {each!r}?" for each in get_close_matches(name, [*known, *others], n=1))
        raise ArgumentError(f"{type(options).__name__} has no option {name!r}{close}")
    return replace(options, **given)


def check_parameter(name: str, annotation: Any, value: Any) -> None:
    """Refuse a parameter's value that its annotation does not allow."""
    entry = declaration(name, Annotated[annotation, Option("")])
    assert entry is not None
    entry.taken(value)


def documented(kind: Class) -> Class:
    """Describe the options of a class in its documentation."""
    options = declared(kind).items()
    entries = (f"{name}\n    {each.option.in_unit(each.option.unit)}" for name, each in options)
    kind.__doc__ = "\n".join([kind.__doc__ or "", "", "Attributes", "----------", *entries])
    return kind


def _members(kind: Any) -> Sequence[Any]:
    return [m for each in get_args(kind) for m in _members(each)] if get_origin(kind) in (Union, UnionType) else [kind]


def _taken(value: Any, kind: Any, option: Option) -> Any:
    """The value as one of a type; ValueError or TypeError where it is none."""
    if (kind in (bool, int, float) or get_origin(kind)) and hasattr(value, "tolist"):  # NumPy's
        value = value.tolist()
    if get_origin(kind) is tuple:
        if not isinstance(value, Sequence) or isinstance(value, str | bytes):
            raise TypeError
        parts = get_args(kind)
        kinds = parts[:1] * len(value) if parts[-1] is Ellipsis else parts
        return tuple(_taken(item, part, option) for item, part in zip(value, kinds, strict=True))
    if kind in (int, float):
        number = isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
        fits = number and value in option.within
    elif isinstance(kind, ForwardRef):  # names of classes that are not imported here; what is like an array, NumPy says
        own = (base for base in type(value).__mro__ if base.__module__.partition(".")[0] in ("rdstitch", "builtins"))
        known, names = kind.__forward_arg__.split(" | "), {base.__name__ for base in own}
        fits = "ArrayLike" in known or isinstance(value, PathLike) or not names.isdisjoint(known)
    else:
        fits = isinstance(value, {str: str, Path: PathLike, bool: bool}.get(kind, object))
    if not fits:
        raise ValueError
    return float(value) if kind is float else value


def _in_words(kind: Any, option: Option) -> str:
    unit = f", {option.unit}," if option.unit else ""
    if get_origin(kind) is tuple:
        parts = get_args(kind)
        return f"{len(parts)} numbers{unit}{option.within}" if parts[-1] is not Ellipsis else "a list"
    if isinstance(kind, ForwardRef):
        return f"{kind.__forward_arg__.split()[0]} or a file"
    names = {
        bool: "true or false",
        int: f"a whole number{unit}{option.within}",
        float: f"a number{unit}{option.within}",
        Path: "a file",
    }
    return names.get(kind, "a text")
