"""Strict reading of JSON: every value is checked, and every complaint names the file and the field."""

import json
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Never, Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.errors import InputError
from rdstitch.file_access import read_limited

MAX_FILE = 256 * 2**20  # bytes; a sidecar of ten thousand images has about 30 MB
_MAX_SIDE = 10**7  # pixels
_MIN_ENTRY, _MAX_ENTRY = 1e-30, 1e30  # of matrices
_DEEPEST = 50  # objects and lists within one another


def read_text(path: str | Path, *, regular: bool = True) -> str:
    """The text of a file of a reasonable size.

    Parameters
    ----------
    regular : bool
        Refuse pipes and devices, of which reading may not come to an end.

    Raises
    ------
    InputError
        When it cannot be read.
    """
    try:
        # Names of files that are not UTF-8 are written as they are, and come back as they were.
        return read_limited(path, MAX_FILE, regular=regular).decode("utf-8-sig", "surrogateescape")
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error


def read_json(path: str | Path) -> "Record":
    """A JSON file as a record to be taken apart.

    Raises
    ------
    InputError
        When the file cannot be read or is no JSON.
    """
    return parse_json(read_text(path), str(path))


def parse_json(text: str, file: str) -> "Record":
    """JSON text as a record; ``file`` is what messages call it."""
    try:
        value = json.loads(text)
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise InputError(f"{file}: is not JSON: {error.msg} at {where}") from error
    except (RecursionError, ValueError) as error:
        raise InputError(f"{file}: is not JSON that can be read: {error}") from error
    _check(file, value)
    return Record(file, "", value)


def _check(file: str, value: Any) -> None:
    """Refuse what is too deep to be walked through, and numbers that JSON cannot express."""
    containers: list[tuple[str, int, Any]] = [("", 1, {"": value})]
    while containers:
        field, depth, container = containers.pop()
        if depth > _DEEPEST:
            raise InputError(f"{file}: {field}: is nested too deeply")
        for key, item in container.items() if isinstance(container, dict) else enumerate(container):
            if isinstance(item, float) and not math.isfinite(item):
                raise InputError(f"{file}: {_within(field, key)}: expected a finite number, not {item}")
            if isinstance(item, (dict, list)):
                containers.append((_within(field, key), depth + 1, item))


def _within(field: str, key: str | int) -> str:
    """Name of a field of a field."""
    if isinstance(key, int):
        return f"{field}[{key}]"
    return f"{field}.{key}" if field else key


class Record:
    """A value of a JSON file with its place in it; every reading method raises InputError for what it does not expect.

    Parameters
    ----------
    file : str
        Name of the file, for messages.
    field : str
        Where in the file the value is, such as ``images[2].size``; empty for the whole.
    value : object
        What :func:`json.loads` gives.
    """

    def __init__(self, file: str, field: str, value: Any) -> None:
        self.file, self.field, self.value = file, field, value

    def fail(self, problem: str) -> Never:
        """Refuse the value."""
        raise InputError(f"{self.file}: {self.field or 'the content'}: {problem}")

    def expected(self, what: str) -> Never:
        """Refuse the value since it is something else."""
        shown = json.dumps(self.value, ensure_ascii=False, default=str)
        self.fail(f"expected {what}, not {shown if len(shown) <= 60 else shown[:57] + '...'}")

    def __getitem__(self, key: str) -> Self:
        """The value of a key that must be there."""
        fields = self.fields()
        if key not in fields:
            self._child(key, None).fail("is missing")
        return fields[key]

    def get(self, key: str) -> Self | None:
        """The value of a key; None where it is missing or null."""
        found = self.fields().get(key)
        return None if found is None or found.value is None else found

    def fields(self) -> dict[str, Self]:
        """The values of an object by their keys."""
        if not isinstance(self.value, dict):
            self.expected("an object {...}")
        return {key: self._child(key, value) for key, value in self.value.items()}

    def items(self) -> Iterator[Self]:
        """The values of a list."""
        if not isinstance(self.value, list):
            self.expected("a list [...]")
        for index, value in enumerate(self.value):
            yield type(self)(self.file, _within(self.field, index), value)

    def text(self) -> str:
        """A string."""
        if not isinstance(self.value, str):
            self.expected("a text")
        return self.value

    def choice(self, allowed: Iterable[str]) -> str:
        """One of several strings."""
        known = tuple(allowed)
        if self.value not in known:
            self.expected("one of " + ", ".join(known))
        return str(self.value)

    def flag(self) -> bool:
        """True or false."""
        if not isinstance(self.value, bool):
            self.expected("true or false")
        return self.value

    def integer(self, least: int | None = None) -> int:
        """A whole number, also where it is written as 3.0."""
        value = self.value
        if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int) or (least is not None and value < least):
            self.expected("a whole number" + ("" if least is None else f" of at least {least}"))
        return int(value)

    def number(self) -> float:
        """A finite number."""
        if isinstance(self.value, bool) or not isinstance(self.value, (int, float)):
            self.expected("a number")
        try:
            value = float(self.value)
        except OverflowError:
            self.expected("a number of reasonable size")
        if not math.isfinite(value):
            self.expected("a finite number")
        return value

    def numbers(self, count: int | None = None) -> tuple[float, ...]:
        """A list of finite numbers, so many of them."""
        values = tuple(item.number() for item in self.items())
        if count is not None and len(values) != count:
            self.expected(f"{count} numbers")
        return values

    def pair(self) -> tuple[float, float]:
        """Two finite numbers."""
        first, second = self.numbers(2)
        return first, second

    def size(self) -> tuple[int, int]:
        """Width and height of an image, pixels."""
        values = [item.side() for item in self.items()]
        if len(values) != 2:
            self.expected("width and height in pixels")
        return values[0], values[1]

    def side(self) -> int:
        """Width or height of an image, pixels."""
        value = self.integer(1)
        if value > _MAX_SIDE:
            self.expected("a width or height in pixels")
        return value

    def matrix(self) -> NDArray[np.float64]:
        """A 3 x 3 matrix that can be inverted."""
        rows = [row.numbers(3) for row in self.items()]
        if len(rows) != 3:
            self.expected("three rows of three numbers")
        array = np.array(rows, dtype=np.float64)
        # Products of several of them must be numbers too.
        if not _MIN_ENTRY <= np.abs(array).max() <= _MAX_ENTRY:
            self.fail(f"the matrix needs entries of {_MIN_ENTRY:g} to {_MAX_ENTRY:g}")
        with np.errstate(all="ignore"):
            scale = np.abs(array).max()
            if scale == 0.0 or not np.linalg.cond(array / scale) < 1e12:
                self.fail("the matrix is singular")
        return array

    def _child(self, key: str, value: Any) -> Self:
        return type(self)(self.file, _within(self.field, key), value)
