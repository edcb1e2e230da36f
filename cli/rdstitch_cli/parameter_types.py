"""Types of options: how the text on the command line becomes a value, and what is said where it cannot."""

import math
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

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


class _WithinLimits:
    """A number within limits, or any, called N in help pages; what was expected is said in words."""

    name, kind = "N", ""

    def convert(self: Any, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            return super().convert(value, param, ctx)  # type: ignore[misc]
        except click.BadParameter:
            limits = ""
            if self.min is not None and self.max is not None:
                limits = f" from {self.min:g} to {self.max:g}"
            elif self.min is not None:
                limits = f" {'above' if self.min_open else 'of at least'} {self.min:g}"
            self.fail(f"expected one {self.kind}{limits}, not {value!r}", param, ctx)

    def _describe_range(self) -> str:
        """Nothing, in help pages: their texts say what matters."""
        return ""


class WholeNumber(_WithinLimits, click.IntRange):
    """A whole number."""

    name, kind = "N", "whole number"


class RealNumber(_WithinLimits, click.FloatRange):
    """A number."""

    name, kind = "N", "number"


class FileOr(UserPath):
    """A file, or a word that stands for something else; a file of that name is written ``./word``."""

    def __init__(self, *words: str) -> None:
        super().__init__()
        self.words = words

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Keep the word; of anything else, make a path."""
        return value if value in self.words else super().convert(value, param, ctx)


class Parsed(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    """What a function makes of the text; it raises ValueError with what is wrong."""

    def __init__(self, name: str, parse: Callable[[str], Any]) -> None:
        self.name, self.parse = name, parse

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not isinstance(value, str):
            return value
        try:
            return self.parse(value)
        except ValueError as error:
            self.fail(f"{value!r} {error}", param, ctx)


def _angles(text: str) -> tuple[float, float]:
    """Two angles, degrees, in radians."""
    try:
        psi, theta = (math.radians(float(part)) for part in text.split(","))
    except ValueError:
        raise ValueError("is not two angles in degrees like 2.5,-1") from None
    if not (abs(psi) < math.pi / 2 and abs(theta) < math.pi / 2):
        raise ValueError("is not a tilt between -90 and 90 degrees")
    return psi, theta


def _angle(text: str) -> float:
    """An angle that is not negative, degrees, in radians."""
    try:
        angle = math.radians(float(text))
    except ValueError:
        angle = math.nan
    if not 0.0 <= angle < math.inf:
        raise ValueError("is not an angle in degrees such as 0.5")
    return angle


def _bytes(text: str) -> int:
    """An amount of memory, bytes."""
    parts = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([KMGT]?)(?:i?B)?\s*", text, re.IGNORECASE)
    amount = int(float(parts[1]) * 2 ** (10 * " KMGT".index(parts[2].upper() or " "))) if parts else 0
    if amount < 1:
        raise ValueError("is not an amount of memory such as 800M or 2G")
    return amount


def _epsg(text: str) -> int:
    """The number of a coordinate system."""
    number = text.upper().removeprefix("EPSG:")
    if not (number.isdecimal() and 0 < int(number) < 2**16):
        raise ValueError("is not a code like EPSG:25832")
    return int(number)


def _pixels(text: str, count: int) -> tuple[float, ...]:
    """So many coordinates of places in an image."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"is not {count} numbers with commas between them")
    return numbers


def _lines(text: str) -> str | tuple[tuple[float, ...], ...]:
    """A word, or lines by both ends."""
    return text if text in ("off", "auto") else tuple(_pixels(line, 4) for line in text.split(";"))


def _lens(text: str) -> float | str:
    """λ, or that it is to be estimated."""
    try:
        value = text if text == "auto" else float(text)
    except ValueError:
        value = math.nan
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError("is neither auto nor a number")
    return value


def _bands(text: str) -> dict[str, str]:
    """Patterns of images by the names of bands."""
    pairs = [part.partition("=") for part in text.split(",")]
    bands = {name.strip(): pattern.strip() for name, _, pattern in pairs}
    if len(bands) < max(2, len(pairs)) or not all(bands) or not all(bands.values()) or set("/\\") & set("".join(bands)):
        raise ValueError("is not a list like NIR=*_NIR.TIF,RED=*_RED.TIF")
    return bands


ANGLES, ANGLE, BANDS, BYTES, EPSG, EXTENT, CORNERS, LINES, LENS = (
    Parsed(name, parse)
    for name, parse in (
        ("PSI,THETA", _angles),
        ("DEG", _angle),
        ("NAME=PATTERN,…", _bands),
        ("SIZE", _bytes),
        ("EPSG:N", _epsg),
        ("W,S,E,N", partial(_pixels, count=4)),
        ("X1,Y1,…,X4,Y4", partial(_pixels, count=8)),
        ("off|auto|LINES", _lines),
        ("L|auto", _lens),
    )
)


def word_or_number(words: Sequence[str], least: int, most: int) -> Parsed:
    """One of some words, or a whole number within limits."""

    def parse(text: str) -> str | int:
        if text in words:
            return text
        if not (text.isdecimal() and least <= int(text) <= most):
            raise ValueError(f"is neither {' nor '.join(words)} nor a number from {least} to {most}")
        return int(text)

    return Parsed("integer", parse)
