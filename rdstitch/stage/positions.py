"""Nominal places of tiles by what users have: a table, file names, OME-XML, Micro-Manager's metadata."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from rdstitch.errors import ArgumentError, InputError
from rdstitch.inputs.tables import by_image, csv_rows
from rdstitch.io.metadata import read_ome
from rdstitch.io.opening import TIFF_MAGIC, decoding
from rdstitch.stage.grid import TileGrid
from rdstitch.system.file_access import canonical_name, canonical_text, open_regular, read_text

_COLUMNS = {"name": "name file filename image", "x": "x xpx", "y": "y ypx", "x_um": "xum", "y_um": "yum"}
_METADATA_FILE = "metadata.txt"
_HOW = (
    "say where they are: --grid 'r{row}c{col}' --overlap PERCENT for names, or --positions FILE with name,x,y; "
    "OME-TIFF and Micro-Manager files may say it themselves"
)


@dataclass(frozen=True)
class StagePosition:
    """The place of one tile."""

    x: float
    y: float
    unit: float | None  # micrometres that these count; None for pixels
    pixel_size: float | None = None  # micrometres, where the file says it


def grid_from_names(names: Sequence[str], pattern: str, overlap: float, size: tuple[int, int]) -> TileGrid:
    """Places by rows and columns in file names."""
    if pattern.count("{row}") != 1 or pattern.count("{col}") != 1:
        raise ArgumentError(f"the grid '{pattern}' must have {{row}} and {{col}} once each, as in 'r{{row}}c{{col}}'")
    if not 0.0 <= overlap < 100.0:
        raise ArgumentError(f"tiles overlap by 0 to less than 100 %, not {overlap:g} %")
    expression = re.escape(pattern).replace(r"\{row\}", r"(?P<row>\d+)").replace(r"\{col\}", r"(?P<col>\d+)")
    wanted = re.compile(expression.replace(r"\*", ".*"))
    cells = []
    for name in names:
        fitting = wanted.search(name)
        if fitting is None:
            raise ArgumentError(f"{name}: does not fit the grid '{pattern}'")
        cells.append((int(fitting["col"]), int(fitting["row"])))
    if len(set(cells)) < len(cells):
        twice = next(cell for cell in cells if cells.count(cell) > 1)
        raise ArgumentError(f"several tiles are row {twice[1]}, column {twice[0]}; name those of one channel only")
    places = np.array(cells, dtype=np.float64) - np.min(cells, axis=0)
    return TileGrid(places * np.array(size) * (1.0 - overlap / 100.0), size, None, f"file names, {overlap:g} % overlap")


def grid_from_table(
    names: Sequence[str], file: str | Path, size: tuple[int, int], pixel_size: float | None
) -> TileGrid:
    """Places by a CSV file with the columns ``name``, ``x`` and ``y``, pixels, or ``x_um`` and ``y_um``."""
    rows = by_image(csv_rows(read_text(file), str(file), _COLUMNS, ("name,x,y", "name,x_um,y_um")))
    pixels = any("x" in row.values for row in rows.values())
    x, y, unit = ("x", "y", None) if pixels else ("x_um", "y_um", 1.0)
    table = {name: StagePosition(row.needed(x), row.needed(y), unit) for name, row in rows.items()}
    missing = [item for item in names if item not in table]
    if missing:
        raise InputError(f"{file}: has no line for {missing[0]}; add one with its place")
    return _grid([table[item] for item in names], size, pixel_size, Path(file).name)


def grid_from_files(files: Sequence[Path], size: tuple[int, int], pixel_size: float | None) -> TileGrid:
    """Places by what the files say: OME-XML, Micro-Manager's tags, or its ``metadata.txt`` beside them."""
    beside: dict[Path, dict[str, StagePosition]] = {}
    positions = []
    for file in files:
        position = position_of(file)
        if position is None:
            folder = file.parent
            if folder not in beside:
                beside[folder] = _micro_manager_file(folder / _METADATA_FILE)
            position = beside[folder].get(canonical_name(file.name))
        if position is None:
            raise InputError(f"{file}: does not say where it was taken; {_HOW}")
        positions.append(position)
    return _grid(positions, size, pixel_size, "the files' metadata")


def position_of(file: Path) -> StagePosition | None:
    """Read where a TIFF file was taken; None where it does not say."""
    with decoding(file):
        with open_regular(file) as stream:
            if stream.read(4) not in TIFF_MAGIC:
                return None
            stream.seek(0)
            with tifffile.TiffFile(stream, name=str(file)) as tiff:
                ome, tag = tiff.ome_metadata, tiff.pages.first.tags.get("MicroManagerMetadata")
        told = read_ome(ome)
        if told is not None and told.position is not None:
            return StagePosition(*told.position, told.unit, told.pixel_size)
        return None if tag is None else _micro_manager_position(tag.value)


def _micro_manager_file(file: Path) -> dict[str, StagePosition]:
    """Places by file name in Micro-Manager's ``metadata.txt``; none where there is no such file."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    positions = {}
    for key, entry in content.items() if isinstance(content, dict) else ():
        position = _micro_manager_position(entry) if isinstance(entry, dict) else None
        if position is not None:
            name = entry.get("FileName") or key.removeprefix("Metadata-")
            positions[canonical_text(Path(str(name)).name)] = position
    return positions


def _micro_manager_position(entry: Any) -> StagePosition | None:
    """A place among what Micro-Manager wrote of one image."""
    try:
        x, y = float(entry["XPositionUm"]), float(entry["YPositionUm"])
        size = float(entry.get("PixelSizeUm") or 0.0)
    except (TypeError, ValueError, LookupError, AttributeError):
        return None
    return StagePosition(x, y, 1.0, size or None)


def _grid(positions: Sequence[StagePosition], size: tuple[int, int], pixel_size: float | None, source: str) -> TileGrid:
    """Places in pixels, whatever they were given in."""
    pixel_size = pixel_size or next((item.pixel_size for item in positions if item.pixel_size), None)
    places = np.array([(item.x, item.y) for item in positions], dtype=np.float64)
    unit = positions[0].unit
    if unit is not None:
        if pixel_size is None:
            raise InputError(f"{source}: gives micrometres, but no file says how large a pixel is; add --pixel-size UM")
        places *= unit / pixel_size
    return TileGrid(places - places.min(axis=0), size, pixel_size, source)
