"""Tables that users have: CSV, lists of fields between blanks, and records of JSON, as rows with named columns.

A caller says which columns it knows and what else they are called, and which of them a table must have::

    COLUMNS = {"name": "name file image", "x": "x easting", "y": "y northing"}
    for row in csv_rows(text, file, COLUMNS, ("name,x,y",), units=("m",)):
        row.image, row.number("x"), row.number("y")

Lists that are no tables are read line by line: :func:`numbered_lines`.

Headings count without regard to case, blanks, underscores and a group (``EXIF:``). A unit in brackets belongs to the
heading where the caller knows it so (``x (um)`` is ``xum``); else it must be one of ``units``. The delimiter is the
comma, semicolon or tab that is in the heading most often. Lines that begin with ``#`` say nothing, except that the
heading may stand in one. Numbers are read in either notation (``580,015.975``, ``580.015,975``, ``580'015.975``); what
could be two numbers is one of them where the rest of the table shows the decimal mark, and refused elsewhere.

Every complaint names the file and the line. Which image a row is about, :mod:`rdstitch.inputs.rows_of_images` finds.
"""

import csv
import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from math import isfinite
from typing import Any

from rdstitch.errors import InputError
from rdstitch.system.file_access import canonical_text
from rdstitch.system.records import parse_json

IMAGE_NAMES, TIME_NAMES = "name filename file image imagename", "timestamp time stamp"  # of columns

_DELIMITERS = ",;\t"
_HEADING = re.compile(r"(?:.*:)?([^\[(]*)(?:[\[(]([^\])]*)[\])]?.*)?", re.DOTALL)
_EMPTY = ("", "-", "nan", "n/a", "na", "none", "null")
# A number by its decimal mark; the other mark may stand between groups of three digits.
_NOTATIONS = {
    mark: re.compile(rf"(?=[-+]?[.,]?\d)[-+]?(\d+|[1-9]\d{{0,2}}(\{other}\d{{3}})+)?(\{mark}\d*)?([eE][-+]?\d+)?")
    for mark, other in (".,", ",.")
}
_GROUPED = re.compile(r"(?<=\d)[\s'’](?=\d{3}(?!\d))")
NUMERAL = re.compile(r"[-+\u2212]?[.,]?\d+(?:[.,]\d+)*(?:[eE][-+]?\d+)?")


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


def name_parts(text: str) -> tuple[str, ...]:
    """A file's folders and its name, by whatever system they were written, spelled as the names of images are."""
    return tuple(part for part in re.split(r"[\\/]", canonical_text(text.strip())) if part not in ("", ".", ".."))


def csv_rows(
    text: str, file: str, columns: Mapping[str, str], wanted: Sequence[str], units: Sequence[str] = ()
) -> list[Row]:
    """The rows of a CSV file with a heading; ``wanted`` are the columns that there must be, and alternatives to them.

    They are named by headings, as messages name them. Of each column ``columns`` has all headings that mean it, between
    blanks. Others are ignored; of several with one meaning the last counts that is not empty. ``file`` is what messages
    call it.
    """
    if "\0" in text:
        raise InputError(f"{file}: is not UTF-8 text; save it as CSV in UTF-8")
    known = _finder(file, columns, units)
    lines = list(io.StringIO(text, newline=None))
    start = next((n for n, line in enumerate(lines) if _is_heading(line, known)), 0)
    heading = lines[start].lstrip("# ") if lines else ""
    # Comments become empty lines, so that the others keep their numbers.
    rest = ("" if line.startswith("#") else line for line in lines[start + 1 :])
    reader = csv.reader([heading, *rest], delimiter=_delimiter(heading), skipinitialspace=True, strict=True)
    try:
        headings = next(reader, [])
        meanings = [known(heading) for heading in headings]
        if not any({known(name) or name for name in names.split(",")} <= set(meanings) for names in wanted):
            raise InputError(f"{file}: its first line names no columns like {' or '.join(wanted)}")
        rows = []
        for fields in reader:
            where = f"{file}: line {reader.line_num + start}"
            if any(field.strip() for field in fields[len(headings) :]):
                raise InputError(f"{where}: has {len(fields)} fields, but there are {len(headings)} columns")
            if any(field.strip() for field in fields):
                rows.append((where, zip(meanings, fields, strict=False)))
    except csv.Error as error:
        raise InputError(f"{file}: line {reader.line_num + start}: is not CSV: {error}") from error
    return rows_of(rows)


def is_table(
    text: str, file: str, columns: Mapping[str, str], is_listed: Callable[[str], object], units: Sequence[str]
) -> bool:
    """Whether it is what :func:`csv_rows` reads, not a list, above which a comment may name columns too.

    ``is_listed`` tells a line of the list, which may hold decimal commas.
    """
    known = _finder(file, columns, units)
    heading = next((line for line in text.splitlines() if _is_heading(line, known)), "")
    first = next((line for _, line in numbered_lines(text, file)), "")
    delimiter = _delimiter(heading)
    return _names_columns(heading, known) and delimiter in first and (delimiter == "\t" or not is_listed(first))


def json_rows(text: str, file: str, columns: Mapping[str, str], wanted: str) -> list[Row]:
    """The objects of a JSON list, as ``exiftool -json`` writes them; ``wanted`` describes them where there are none."""
    content = parse_json(text, file)
    if not isinstance(content, list) or not all(isinstance(item, dict) for item in content):
        raise InputError(f"{file}: expected {wanted}")
    known = _finder(file, columns, ())
    return rows_of(
        (f"{file}: [{number}]", ((known(key), value) for key, value in item.items()))
        for number, item in enumerate(content)
    )


def numbered_lines(text: str, file: str) -> list[tuple[str, str]]:
    """Where each line is, for messages, and what it says, but for empty ones and those that begin with ``#``."""
    lines = ((f"{file}: line {n}", line.strip()) for n, line in enumerate(text.splitlines(), start=1))
    return [(where, line) for where, line in lines if line and not line.startswith("#")]


def numbers_before(fields: Sequence[str]) -> list[str]:
    """Those of the fields before the first that is no number, nor an empty one."""
    return list(takewhile(lambda field: _readings(field) or field.lower() in _EMPTY, fields))


def rows_of(found: Iterable[tuple[str, Iterable[tuple[str | None, Any]]]]) -> list[Row]:
    """Rows with the decimal mark that their unambiguous numbers share."""
    rows = []
    for where, pairs in found:
        texts = ((column, "" if value is None else str(value).strip()) for column, value in pairs)
        rows.append((where, {column: value for column, value in texts if column and value}))
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
    """What a numeral is, by the decimal mark."""
    numbers, text = {}, text.replace("\u2212", "-")  # as spreadsheets and web pages write minus
    for mark, notation in _NOTATIONS.items():
        if notation.fullmatch(text):
            numbers[mark] = float(text.replace("," if mark == "." else ".", "").replace(mark, "."))
    return numbers


def _finder(file: str, columns: Mapping[str, str], units: Sequence[str]) -> Callable[[str], str | None]:
    """Which column a heading means."""
    meaning = {alias: column for column, aliases in columns.items() for alias in aliases.split()}

    def plain(text: str) -> str:
        return "".join(letter for letter in text.lower() if letter.isalpha()).replace("µ", "u").replace("μ", "u")

    def find(heading: str) -> str | None:
        parts = _HEADING.fullmatch(str(heading))
        assert parts is not None
        word, unit = plain(parts[1]), plain(parts[2] or "")
        if word + unit in meaning:
            return meaning[word + unit]
        if meaning.get(word, "name") != "name" and unit not in ("", *units):
            known = f"; give it in {' or '.join(units)}" if units else ""
            raise InputError(f"{file}: the column '{heading.strip()}' has a unit that is not known here{known}")
        return meaning.get(word)

    return find


def _is_heading(line: str, known: Callable[[str], str | None]) -> bool:
    """Check whether a line is the heading: the first one that is no comment, or a comment that names columns."""
    return _names_columns(line, known) if line.startswith("#") else bool(line.strip())


def _names_columns(line: str, known: Callable[[str], str | None]) -> bool:
    return sum(known(field) is not None for field in re.split(f"[{_DELIMITERS}]", line.lstrip("# "))) > 1


def _delimiter(heading: str) -> str:
    return max(_DELIMITERS, key=heading.count)
