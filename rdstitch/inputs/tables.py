"""Tables that users have: CSV, lists of fields between blanks, and records of JSON, as rows with named columns.

A caller says which columns it knows and what else they are called, and which of them a table must have::

    COLUMNS = {"name": "name file image", "x": "x easting", "y": "y northing"}
    for row in csv_rows(text, file, COLUMNS, ("name,x,y",), units={"x": "m", "y": "m"}):
        row.image, row.number("x"), row.number("y")

Lists that are no tables are read line by line: :func:`numbered_lines`.

Headings count without regard to case, blanks, underscores and a group (``EXIF:``). A unit in brackets belongs to the
heading where the caller knows it so (``x (um)`` is ``xum``); else it must be one of the column's ``units``. The
delimiter is the comma, semicolon or tab that is in the heading most often. Lines that begin with ``#`` say nothing,
except that the heading may stand in one. Numbers are read in either notation (``580,015.975``, ``580.015,975``,
``580'015.975``); what could be two numbers is one of them where the rest of the table shows the decimal mark, and
refused elsewhere.

Every complaint names the file and the line. Which image a row is about, :mod:`rdstitch.inputs.rows_of_images` finds.
"""

import csv
import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import takewhile
from math import isfinite
from types import MappingProxyType
from typing import Any

from rdstitch.errors import InputError
from rdstitch.system.file_access import canonical_text
from rdstitch.system.records import parse_json

IMAGE_NAMES, TIME_NAMES = "name filename file image imagename", "timestamp time stamp"  # of columns

_MAX_SECONDS = 1e11  # since 1970, in the year 5138; since 1973 milliseconds are more
_DELIMITERS = ",;\t"
_SEPARATOR = re.compile("sep=.?", re.IGNORECASE)
_HEADING = re.compile(r"(?:.*:)?([^\[(]*)(?:[\[(]([^\])]*)[\])]?.*)?", re.DOTALL)
_EMPTY = ("", "-", "nan", "n/a", "na", "none", "null")
# A number by its decimal mark; the other mark may stand between groups of three digits.
_NOTATIONS = {
    mark: re.compile(rf"(?=[-+]?[.,]?\d)[-+]?(\d+|[1-9]\d{{0,2}}(\{other}\d{{3}})+)?(\{mark}\d*)?([eE][-+]?\d+)?")
    for mark, other in (".,", ",.")
}
_GROUPED = re.compile(r"(?<=\d)[\s'’](?=\d{3}(?!\d))")
NUMERAL = re.compile(r"[-+\u2212]?[.,]?\d+(?:[.,]\d+)*(?:[eE][-+]?\d+)?")
_NO_UNITS = MappingProxyType[str, str]({})


@dataclass(frozen=True)
class Row:
    """One row of a table."""

    where: str  # the file and the line, for messages
    values: Mapping[str, str]  # by the caller's columns; empty ones are not in it
    decimal: str = ""  # the table's decimal mark, "." or ","; empty where it does not show that

    @property
    def image(self) -> str:
        """The name of the image's file, without its folder."""
        if not (parts := name_parts(self.values.get("name", ""))):
            raise InputError(f"{self.where}: has no name")
        return parts[-1]

    def number(self, column: str) -> float | None:
        """The finite number in a column; None where it is empty."""
        text = self.values.get(column, "")
        if text.lower() in _EMPTY:
            return None
        if (value := self._parsed(_GROUPED.sub("", text))) is None:
            raise InputError(f"{self.where}: expected a number for {column}, not '{text}'")
        return value

    def needed(self, column: str) -> float:
        """The finite number in a column, which must not be empty."""
        if (value := self.number(column)) is None:
            raise InputError(f"{self.where}: has no number for {column}")
        return value

    def seconds(self) -> float:
        """The time stamp, which the row must have."""
        return seconds_of(self.needed("timestamp"), self.where)

    def numbers_within(self, column: str) -> list[float]:
        """All numbers in a text like ``48 deg 51' 29.60" N``."""
        values = (self._parsed(part) for part in NUMERAL.findall(self.values.get(column, "")))
        return [value for value in values if value is not None]

    def _parsed(self, text: str) -> float | None:
        readings = _readings(text)
        if "," in text and len(set(readings.values())) > 1 and not self.decimal:
            raise InputError(f"{self.where}: '{text}' could be two numbers; write it without a comma")
        value = readings.get(self.decimal or ".", next(iter(readings.values()), None))
        return value if value is not None and abs(value) < float("inf") else None


def is_number(text: str) -> bool:
    """Whether it is a number in the notation of programs."""
    try:
        return isfinite(float(text))
    except ValueError:
        return False


def seconds_of(time: float, where: str) -> float:
    """A time in seconds; one that can only be in a smaller unit is refused."""
    if abs(time) > _MAX_SECONDS:
        raise InputError(f"{where}: expected a time in seconds, not {time:.0f}; is it in nanoseconds?")
    return time


def name_parts(text: str) -> tuple[str, ...]:
    """A file's folders and its name, by whatever system they were written, spelled as the names of images are."""
    return tuple(part for part in re.split(r"[\\/]", canonical_text(text.strip())) if part not in ("", ".", ".."))


def csv_rows(
    text: str, file: str, columns: Mapping[str, str], wanted: Sequence[str], units: Mapping[str, str] = _NO_UNITS
) -> list[Row]:
    """The rows of a CSV file with a heading; ``wanted`` are the columns that there must be, and alternatives to them.

    They are named by headings, as messages name them. Of each column ``columns`` has all headings that mean it, between
    blanks, and ``units`` all units of a heading. Others are ignored; of several with one meaning the last counts that
    is not empty, but no two numbers that differ, unless they are of groups. ``file`` is what messages call it.
    """
    if "\0" in text:
        raise InputError(f"{file}: is not UTF-8 text; save it as CSV in UTF-8")
    column_of = _column_finder(file, columns, units)
    lines = list(io.StringIO(text, newline=None))
    start = next((n for n, line in enumerate(lines) if _is_heading(line, column_of)), 0)
    heading = lines[start].lstrip("# ") if lines else ""
    # Comments become empty lines, so that the others keep their numbers.
    rest = ("" if line.startswith("#") else line for line in lines[start + 1 :])
    reader = csv.reader([heading, *rest], delimiter=_delimiter(heading), skipinitialspace=True, strict=True)
    try:
        headings = next(reader, [])
        present = set(map(column_of, headings))
        if not any({column_of(name) or name for name in names.split(",")} <= present for names in wanted):
            found = f": '{heading.strip()[:60]}'" if heading.strip() else ""
            raise InputError(f"{file}: its first line names no columns like {' or '.join(wanted)}{found}")
        rows = []
        for fields in reader:
            where = f"{file}: line {reader.line_num + start}"
            if any(field.strip() for field in fields[len(headings) :]):
                raise InputError(f"{where}: has {len(fields)} fields, but there are {len(headings)} columns")
            if any(field.strip() for field in fields):
                rows.append((where, zip(headings, fields, strict=False)))
    except csv.Error as error:
        raise InputError(f"{file}: line {reader.line_num + start}: is not CSV: {error}") from error
    if not rows:
        raise InputError(f"{file}: has no rows below its heading")
    return rows_of(rows, column_of)


def is_table(
    text: str,
    file: str,
    columns: Mapping[str, str],
    is_listed: Callable[[str], object],
    units: Mapping[str, str] = _NO_UNITS,
) -> bool:
    """Whether it is what :func:`csv_rows` reads, not a list, above which a comment may name columns too.

    ``is_listed`` tells a line of the list, which may hold decimal commas.
    """
    column_of = _column_finder(file, columns, units)
    heading = next((line for line in text.splitlines() if _is_heading(line, column_of)), "")
    first = next((line for _, line in numbered_lines(text, file)), "")
    delimiter = _delimiter(heading)
    return _names_columns(heading, column_of) and delimiter in first and (delimiter == "\t" or not is_listed(first))


def json_rows(text: str, file: str, columns: Mapping[str, str], wanted: str) -> list[Row]:
    """The objects of a JSON list, as ``exiftool -json`` writes them; ``wanted`` describes them where there are none."""
    content = parse_json(text, file)
    if not isinstance(content, list) or not all(isinstance(item, dict) for item in content):
        raise InputError(f"{file}: expected {wanted}")
    rows = ((f"{file}: [{number}]", item.items()) for number, item in enumerate(content))
    return rows_of(rows, _column_finder(file, columns, _NO_UNITS))


def numbered_lines(text: str, file: str) -> list[tuple[str, str]]:
    """Lines with their places, for messages, but for empty ones and those that begin with ``#``."""
    lines = ((f"{file}: line {n}", line.strip()) for n, line in enumerate(text.splitlines(), start=1))
    return [(where, line) for where, line in lines if line and not line.startswith("#")]


def numbers_before(fields: Sequence[str]) -> list[str]:
    """Fields before the first that is no number, nor an empty one."""
    return list(takewhile(lambda field: _readings(field) or field.lower() in _EMPTY, fields))


def rows_of(
    cells_of_rows: Iterable[tuple[str, Iterable[tuple[str, Any]]]], column_of: Callable[[str], str | None] = str
) -> list[Row]:
    """Rows of cells with their headings, with the decimal mark that their unambiguous numbers share."""
    rows = []
    for where, cells in cells_of_rows:
        values: dict[str, str] = {}
        for heading, cell in cells:
            column, text = column_of(heading), "" if cell is None else str(cell).strip()
            if not column or not text:
                continue
            if column in values and column != "name" and ":" not in heading:
                before, now = _readings(values[column]), _readings(text)
                if before and now and {*before.values()}.isdisjoint(now.values()):
                    two = f"{values[column]} and {text}"
                    raise InputError(f"{where}: has two numbers for {column}, {two}; remove one of the columns")
            values[column] = text
        rows.append((where, values))
    numerals = {
        numeral
        for _, values in rows
        for column, text in values.items()
        if column != "name"
        for numeral in NUMERAL.findall(text)
    }
    # Those that can be read in one way only.
    readings = [_readings(text) for text in numerals]
    marks = {mark for reading in readings if len(reading) == 1 for mark in reading}
    decimal = marks.pop() if len(marks) == 1 else ""
    return [Row(where, values, decimal) for where, values in rows]


def _readings(text: str) -> dict[str, float]:
    """Numbers that a numeral may be, by the decimal mark."""
    numbers, text = {}, text.replace("\u2212", "-")  # as spreadsheets and web pages write minus
    for mark, notation in _NOTATIONS.items():
        if notation.fullmatch(text):
            numbers[mark] = float(text.replace("," if mark == "." else ".", "").replace(mark, "."))
    return numbers


def _column_finder(file: str, columns: Mapping[str, str], units: Mapping[str, str]) -> Callable[[str], str | None]:
    """Function that finds which column a heading means."""
    meaning = {alias: column for column, aliases in columns.items() for alias in aliases.split()}

    def plain(text: str) -> str:
        return "".join(letter for letter in text.lower() if letter.isalnum()).replace("µ", "u").replace("μ", "u")

    @cache
    def find(heading: str) -> str | None:
        parts = _HEADING.fullmatch(str(heading))
        assert parts is not None
        word, unit = plain(parts[1]), plain(parts[2] or "")
        if word + unit in meaning:
            return meaning[word + unit]
        column = meaning.get(word)
        known = units.get(column or "", "").split()
        if column not in (None, "name") and unit not in ("", *known):
            remedy = f"; give it in {' or '.join(known)}" if known else ""
            raise InputError(f"{file}: the column '{heading.strip()}' has a unit that is not known here{remedy}")
        return column

    return find


def _is_heading(line: str, column_of: Callable[[str], str | None]) -> bool:
    """Check whether a line is the heading: the first one that is no comment, or a comment that names columns.

    Nor the line ``sep=;`` by which Excel tells the delimiter, and which it writes above the heading.
    """
    if line.startswith("#"):
        return _names_columns(line, column_of)
    return bool(line.strip()) and not _SEPARATOR.fullmatch(line.strip())


def _names_columns(line: str, column_of: Callable[[str], str | None]) -> bool:
    return sum(column_of(field) is not None for field in re.split(f"[{_DELIMITERS}]", line.lstrip("# "))) > 1


def _delimiter(heading: str) -> str:
    return max(_DELIMITERS, key=heading.count)
