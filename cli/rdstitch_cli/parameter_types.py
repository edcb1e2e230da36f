"""Types of options: how the text on the command line becomes a value, and what is said where it cannot."""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import click


class UserPath(click.Path):
    """A file or folder; ``~`` at its beginning is the home folder, also where no shell has replaced it.

    Whether a file can be read is for the library to find out: it knows more, and has an exit status for it.
    """

    def __init__(self, allow_dash: bool = False) -> None:
        super().__init__(path_type=Path, readable=False, allow_dash=allow_dash)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Replace ``~`` and make a path; a file whose name begins with it is written ``./~name``.

        An address stays text: as a path it would lose one of its slashes.
        """
        if "://" in str(value):
            return value
        path = super().convert(value, param, ctx)
        try:
            return path.expanduser() if isinstance(path, Path) else path
        except RuntimeError:  # there is no such user
            return path


def _one_number(number: click.IntRange | click.FloatRange, kind: str) -> str:
    """What was expected, in words."""
    if number.min is None:
        return f"expected one {kind}"
    if number.max is None:
        return f"expected one {kind} {'above' if number.min_open else 'of at least'} {number.min:g}"
    return f"expected one {kind} from {number.min:g} to {number.max:g}"


class WholeNumber(click.IntRange):
    """A whole number within limits, called N in help pages."""

    name = "N"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter:
            self.fail(f"{_one_number(self, 'whole number')}, not {value!r}", param, ctx)

    def _describe_range(self) -> str:
        """Nothing, in help pages: their texts say what matters."""
        return ""


class RealNumber(click.FloatRange):
    """A number within limits, or any, called N in help pages."""

    name = "N"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter:
            self.fail(f"{_one_number(self, 'number')}, not {value!r}", param, ctx)

    def _describe_range(self) -> str:
        """Nothing, in help pages: their texts say what matters."""
        return ""


class Angles(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    """Two angles in degrees, ``PSI,THETA``; the value is in radians."""

    name = "PSI,THETA"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value[0], value[1]
        try:
            psi, theta = (math.radians(float(part)) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not two angles in degrees like 2.5,-1", param, ctx)
        if not (abs(psi) < math.pi / 2 and abs(theta) < math.pi / 2):
            self.fail(f"{value!r}: a tilt lies between -90 and 90 degrees", param, ctx)
        return psi, theta


class FileOr(UserPath):
    """A file, or a word that stands for something else; a file of that name is written ``./word``."""

    def __init__(self, word: str) -> None:
        super().__init__()
        self.word = word

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Keep the word; of anything else, make a path."""
        return value if value == self.word else super().convert(value, param, ctx)


class WordOrNumber(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    """One of some words, or a whole number within limits."""

    name = "integer"

    def __init__(self, words: Sequence[str], least: int, most: int) -> None:
        self.words, self.least, self.most = words, least, most

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str | int:
        if value in self.words:
            return str(value)
        try:
            number = int(str(value))
        except ValueError:
            number = self.least - 1
        if not self.least <= number <= self.most:
            self.fail(
                f"{value!r} is neither {' nor '.join(self.words)} nor a number from {self.least} to {self.most}",
                param,
                ctx,
            )
        return number


class Bytes(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    """An amount of memory like ``800M`` or ``1.5G``; the value is in bytes."""

    name = "SIZE"
    units: ClassVar[dict[str, int]] = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, int):
            return value
        parts = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([KMGT]?)(?:i?B)?\s*", str(value), re.IGNORECASE)
        amount = int(float(parts[1]) * self.units[parts[2].upper()]) if parts else 0
        if amount < 1:
            self.fail(f"{value!r} is no amount of memory like 800M or 2G", param, ctx)
        return amount


class Angle(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    """An angle in degrees that is not negative; the value is in radians."""

    name = "DEG"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        try:
            angle = math.radians(float(value))
        except ValueError:
            angle = math.nan
        if not 0.0 <= angle < math.inf:
            self.fail(f"{value!r} is no angle in degrees like 0.5", param, ctx)
        return angle


class Epsg(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    """The code of a coordinate system like ``EPSG:25832``; the value is the number."""

    name = "EPSG:N"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        number = str(value).upper().removeprefix("EPSG:")
        if not (number.isdecimal() and 0 < int(number) < 2**16):
            self.fail(f"{value!r} is not a code like EPSG:25832", param, ctx)
        return int(number)
