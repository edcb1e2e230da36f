"""Deep Zoom (``.dzi``) from strips: JPEG tiles of every size of an image, for viewers in the browser.

An image's levels, each half as large as the next, are cut into tiles while the strips pass; memory is that of a few
strips. Beside ``name.dzi``, which tells the size, the folder ``name_files`` holds ``LEVEL/COLUMN_ROW.jpg``.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.io.encoding import Layout, Strip, as_eight_bit, jpeg_pieces, with_alpha
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import read_image
from rdstitch.io.reduction import halved, reduced_size
from rdstitch.outputs import tiles_folder

MAX_TILE_PROFILE = 2**16
"""Bytes of a colour profile that is written into every tile; the larger ones of RGB images have 60 kB."""

TILE, OVERLAP = 254, 1
"""Side of the tiles and how far they reach into their neighbours, pixels."""

_DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<Image xmlns="http://schemas.microsoft.com/deepzoom/2008" Format="jpg" Overlap="{overlap}" TileSize="{tile}">
  <Size Width="{width}" Height="{height}"/>
</Image>
"""


def write_deep_zoom(description: Path, folder: Path, layout: Layout, strips: Iterable[Strip]) -> None:
    """Write the description and the tiles of an image; transparency becomes the background, 16 bits become 8."""
    width, height = layout.size
    # The profile belongs to the pixels, and so into every tile; EXIF does not.
    kept = layout.metadata.icc_profile if len(layout.metadata.icc_profile) <= MAX_TILE_PROFILE else b""
    profile = Metadata(layout.size, icc_profile=kept)
    eight = replace(layout, dtype=np.dtype(np.uint8), transparent=True, metadata=profile)
    largest = _levels(folder, eight)
    for samples, alpha in strips:
        largest.take(with_alpha(as_eight_bit(samples), alpha))
    description.write_text(
        _DESCRIPTION.format(overlap=OVERLAP, tile=TILE, width=width, height=height), encoding="utf-8"
    )


def read_deep_zoom(path: Path, size: tuple[int, int], side: int) -> NDArray[np.uint8]:
    """Read the smallest level whose longer side has ``side`` pixels, or else the largest, of an image of ``size``."""
    sizes = _sizes(size)
    level = next((k for k, level_size in enumerate(sizes) if max(level_size) >= side), len(sizes) - 1)
    columns, rows = (range(-(-n // TILE)) for n in sizes[level])
    folder = tiles_folder(path) / str(level)

    def tile(column: int, row: int) -> NDArray[np.uint8]:
        pixels: NDArray[np.uint8] = read_image(folder / f"{column}_{row}.jpg").pixels
        return pixels[OVERLAP if row else 0 :][:TILE, OVERLAP if column else 0 :][:, :TILE]

    return np.concatenate([np.concatenate([tile(c, r) for c in columns], axis=1) for r in rows])


def _sizes(size: tuple[int, int]) -> list[tuple[int, int]]:
    """Width and height of every level, from a single pixel up."""
    sizes = [size]
    while max(sizes[-1]) > 1:
        sizes.append(reduced_size(sizes[-1], 2))
    return sizes[::-1]


def _levels(folder: Path, layout: Layout) -> "_Level":
    """The largest level, each with the next smaller one, down to a single pixel."""
    level = None
    for number, size in enumerate(_sizes(layout.size)):
        place = folder / str(number)
        place.mkdir()
        level = _Level(place, replace(layout, size=size), level)
    assert level is not None
    return level


@dataclass
class _Level:
    """One size of the image, which is cut into tiles as its rows come."""

    folder: Path
    layout: Layout
    smaller: "_Level | None"
    _rows: list[NDArray[np.uint8]] = field(default_factory=list)
    _top: int = 0
    _received: int = 0
    _tile_row: int = 0
    _odd: NDArray[np.uint8] | None = None

    def take(self, rows: NDArray[np.uint8]) -> None:
        """The next rows (h, w, C + 1), with alpha, from top to bottom."""
        self._received += len(rows)
        self._rows.append(rows)
        height = self.layout.size[1]
        while self._tile_row * TILE < height:
            top, bottom = _tile_span(self._tile_row, height)
            if bottom > self._received:
                break
            held = np.concatenate(self._rows)
            self._write_tiles(held[top - self._top : bottom - self._top])
            self._tile_row += 1
            next_top = max(0, self._tile_row * TILE - OVERLAP)
            self._rows, self._top = [held[next_top - self._top :]], next_top
        if self.smaller is not None:
            self._pass_on(self.smaller, rows)

    def _pass_on(self, smaller: "_Level", rows: NDArray[np.uint8]) -> None:
        """Half as large, in pairs of rows; the last row of an odd number is its own pair."""
        if self._odd is not None:
            rows = np.concatenate([self._odd, rows])
        pairs = len(rows) if self._received == self.layout.size[1] else len(rows) // 2 * 2
        self._odd = rows[pairs:].copy() if pairs < len(rows) else None
        if pairs:
            smaller.take(halved(rows[:pairs], transparent=True))

    def _write_tiles(self, rows: NDArray[np.uint8]) -> None:
        """One row of tiles."""
        width = self.layout.size[0]
        for column in range(-(-width // TILE)):
            left, right = _tile_span(column, width)
            tile: NDArray[Any] = rows[:, left:right]
            layout = replace(self.layout, size=(right - left, len(rows)))
            with (self.folder / f"{column}_{self._tile_row}.jpg").open("wb") as stream:
                stream.writelines(jpeg_pieces(layout, [(np.ascontiguousarray(tile[..., :-1]), tile[..., -1])]))


def _tile_span(number: int, length: int) -> tuple[int, int]:
    """First and last but one pixel of a tile with its overlap, along one axis of a level."""
    return max(0, number * TILE - OVERLAP), min(length, (number + 1) * TILE + OVERLAP)
