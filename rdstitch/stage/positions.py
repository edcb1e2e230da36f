"""Nominal places of tiles by what users have: file names, a table, Fiji's list, arrays, or what the files say."""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.choices import Origin, ScanOrder
from rdstitch.errors import ArgumentError, InputError
from rdstitch.inputs.frame import Frame
from rdstitch.inputs.rows_of_images import RowsByImage
from rdstitch.inputs.tables import Row, csv_rows
from rdstitch.io.stored_tiles import StoredTile
from rdstitch.stage.grid import TileGrid
from rdstitch.system.file_access import read_text

Positions = str | Path | ArrayLike | Mapping[str, ArrayLike]

_COLUMNS = {"name": "name file filename image", "x": "x xpx", "y": "y ypx", "x_um": "xum", "y_um": "yum"}
_UNITS = {"x": "px um", "y": "px um"}
_PARTS = {"row": r"\d+", "col": r"\d+", "letter": "[A-Za-z]{1,2}", "number": r"\d+"}
_PATTERNS = ({"row", "col"}, {"letter", "col"}, {"number"})
_FIJI = re.compile(r"\s*(?P<name>[^;#]+?)\s*;[^;]*;\s*\(\s*(?P<x>[^,()]+),\s*(?P<y>[^,()]+)(,[^()]*)?\)\s*")
_HOW = (
    "say where they are: --grid 'r{row}c{col}' --overlap PERCENT for names, or --positions FILE with name,x,y; "
    "OME-TIFF and Micro-Manager files may say it themselves"
)


@dataclass(frozen=True)
class Scan:
    """How tiles follow each other by their numbers."""

    columns: int | None = None  # tiles in a row
    order: ScanOrder = "rows"
    origin: Origin = "top-left"

    def __post_init__(self) -> None:
        if self.columns is not None and self.columns < 1:
            raise ArgumentError(f"expected a number of columns from 1 on, not {self.columns}")

    def cell(self, number: int, count: int) -> tuple[int, int]:
        """Column and row of a tile, from the origin, of so many."""
        if self.columns is None:
            raise ArgumentError("tiles with running numbers need the number of columns, as in --columns 10")
        along = self.columns if self.order.endswith("rows") else -(-count // self.columns)
        line, place = divmod(number, along)
        if self.order.startswith("snake") and line % 2:
            place = along - 1 - place
        return (place, line) if self.order.endswith("rows") else (line, place)


def grid_from_names(
    names: Sequence[str],
    pattern: str,
    overlap: float,
    size: tuple[int, int],
    scan: Scan | None = None,
    listed: Sequence[str] = (),
) -> TileGrid:
    """Places by rows and columns, or running numbers, in file names.

    Numbers run from the first to the last of ``listed``, which names tiles too that cannot be read.
    """
    if not 0.0 <= overlap < 100.0:
        raise ArgumentError(f"tiles overlap by 0 to less than 100 %, not {overlap:g} %")
    scan, wanted, parts_of_names = scan or Scan(), _compiled(pattern), []
    for name in names:
        fitting = wanted.search(name)
        if fitting is None:
            raise ArgumentError(f"{name}: does not fit the grid '{pattern}'")
        parts_of_names.append(fitting.groupdict())
    fitting_names = filter(None, map(wanted.search, [*names, *listed]))
    cells = _cells(parts_of_names, scan, [fitting.groupdict() for fitting in fitting_names])
    if len(set(cells)) < len(cells):
        twice = next(cell for cell in cells if cells.count(cell) > 1)
        raise ArgumentError(f"several tiles are row {twice[1]}, column {twice[0]}; name those of one channel only")
    places = np.array(cells, dtype=np.float64) * np.array(size) * (1.0 - overlap / 100.0)
    vertical, horizontal = scan.origin.split("-")
    places *= (1.0 if horizontal == "left" else -1.0, 1.0 if vertical == "top" else -1.0)
    return TileGrid(places - places.min(axis=0), size, None, f"file names, {overlap:g} % overlap")


def _compiled(pattern: str) -> re.Pattern[str]:
    """What finds the parts of a pattern, such as ``r{row}c{col}``, in a name."""
    parts = re.findall(r"\{(\w+)\}", pattern)
    if set(parts) not in _PATTERNS or len(parts) > len(set(parts)):
        raise ArgumentError(
            f"the grid '{pattern}' must have {{row}} and {{col}} once each, as in 'r{{row}}c{{col}}', or {{letter}} "
            "and {col}, or {number}"
        )
    expression = re.escape(pattern).replace(r"\*", ".*")
    for part in parts:
        expression = expression.replace(rf"\{{{part}\}}", f"(?P<{part}>{_PARTS[part]})")
    # A number is whole: not the end of another one.
    return re.compile(rf"(?<!\d){expression}" if pattern.startswith("{") else expression)


def _cells(
    parts: Sequence[Mapping[str, str]], scan: Scan, listed: Sequence[Mapping[str, str]]
) -> list[tuple[int, int]]:
    """Column and row of each tile by what its name says: a running number, among all that were listed, or either."""
    if "number" not in parts[0]:
        return [(int(item["col"]), int(item["row"]) if "row" in item else _number(item["letter"])) for item in parts]
    numbers = [int(item["number"]) for item in listed]
    first, count = min(numbers), max(numbers) - min(numbers) + 1
    return [scan.cell(int(item["number"]) - first, count) for item in parts]


def _number(letters: str) -> int:
    """Rows A, B, … Z, AA, … from 0."""
    number = 0
    for letter in letters.upper():
        number = 26 * number + ord(letter) - ord("A") + 1
    return number - 1


def grid_from_table(
    names: Sequence[str], file: str | Path, size: tuple[int, int], pixel_size: float | None
) -> TileGrid:
    """Places by a CSV file with ``name``, ``x`` and ``y``, or ``x_um`` and ``y_um``, or by Fiji's list, in pixels."""
    text = read_text(file)
    lines = enumerate(map(_FIJI.fullmatch, text.splitlines()), start=1)
    rows = [Row(f"{file}: line {number}", fitting.groupdict(), ".") for number, fitting in lines if fitting is not None]
    rows = rows or csv_rows(text, str(file), _COLUMNS, ("name,x,y", "name,x_um,y_um"), _UNITS)
    x, y, unit = ("x", "y", None) if any("x" in row.values for row in rows) else ("x_um", "y_um", 1.0)
    tiles = [Frame(Path(name), label=name) for name in names]
    places = [(row.needed(x), row.needed(y)) for row in RowsByImage(rows).needed(tiles, file, "place")]
    return _grid(np.array(places), unit, size, pixel_size, Path(file).name)


def grid_from_arrays(
    positions: Any, numbers: Sequence[int], size: tuple[int, int], pixel_size: float | None, listed: Sequence[int]
) -> TileGrid:
    """Places of tiles by their numbers in an array (N, 2), pixels, or in the columns x and y, or x_um and y_um.

    There is one for each number in ``listed``, of tiles too that cannot be read; for frames of videos others between.
    """
    unit = None
    places: FloatArray = np.empty(0)
    if isinstance(positions, Mapping) or hasattr(positions, "columns"):
        pair = next((p for p in (("x", "y"), ("x_um", "y_um")) if all(name in positions for name in p)), None)
        if pair is None:
            raise ArgumentError("positions need x and y, pixels, or x_um and y_um, micrometres")
        unit = 1.0 if pair[0].endswith("um") else None
        positions = zip(*(positions[name] for name in pair), strict=True)
    with suppress(TypeError, ValueError):  # of what is no array of numbers
        places = np.asarray(list(positions), dtype=np.float64)
    count = max(listed) + 1
    allowed = len(places) == count or len(places) > count > len(listed)
    if places.ndim != 2 or places.shape[1] != 2 or not allowed:
        raise ArgumentError(f"positions must be numbers, x and y of each of {count} tiles")
    return _grid(places[list(numbers)], unit, size, pixel_size, "positions")


def grid_from_tiles(tiles: Sequence[StoredTile], size: tuple[int, int], pixel_size: float | None) -> TileGrid:
    """Places by what the files say: OME-XML, or Micro-Manager's metadata."""
    for tile in tiles:
        if tile.position is None:
            raise InputError(f"{tile.name}: does not say where it was taken; {_HOW}")
        if tile.unit != tiles[0].unit:
            raise InputError(f"{tile.name}: gives its place in another unit than {tiles[0].name}; say with --positions")
    pixel_size = pixel_size or next((tile.pixel_size for tile in tiles if tile.pixel_size), None)
    places = np.array([tile.position for tile in tiles], dtype=np.float64)
    return _grid(places, tiles[0].unit, size, pixel_size, "the files' metadata")


def _grid(
    places: FloatArray, unit: float | None, size: tuple[int, int], pixel_size: float | None, source: str
) -> TileGrid:
    """Places in pixels, whatever they were given in."""
    if unit is not None:
        if pixel_size is None:
            raise InputError(f"{source}: gives micrometres, but no file says how large a pixel is; add --pixel-size UM")
        places = places * (unit / pixel_size)
    return TileGrid(places - places.min(axis=0), size, pixel_size, source)
