"""Deep Zoom (``.dzi``) from strips: JPEG tiles of every size of an image, for viewers in the browser.

An image's levels, each half as large as the next, are cut into tiles while the strips pass; memory is that of a few
strips. Beside ``name.dzi``, which tells the size, the folder ``name_files`` holds ``LEVEL/COLUMN_ROW.jpg``.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from rdstitch.arrays import UInt8Array
from rdstitch.io.metadata import Metadata
from rdstitch.io.pyramid import pyramid, pyramid_sizes
from rdstitch.io.read import read_image
from rdstitch.io.strips import ImageSpec, Strip, as_eight_bit, with_alpha
from rdstitch.io.write_jpeg import jpeg_pieces
from rdstitch.system.output_checks import tiles_folder

MAX_TILE_PROFILE = 2**16
"""Bytes of a colour profile that is written into every tile; the larger ones of RGB images have 60 kB."""

TILE, OVERLAP = 254, 1
"""Side of the tiles and how far they reach into their neighbours, pixels."""

_DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<Image xmlns="http://schemas.microsoft.com/deepzoom/2008" Format="jpg" Overlap="{overlap}" TileSize="{tile}">
  <Size Width="{width}" Height="{height}"/>
</Image>
"""


def write_deep_zoom(description: Path, folder: Path, spec: ImageSpec, strips: Iterable[Strip]) -> None:
    """Write the description and the tiles of an image; transparency becomes the background, 16 bits become 8."""
    width, height = spec.size
    # The profile belongs to the pixels, and so into every tile; EXIF does not.
    kept = spec.metadata.icc_profile if len(spec.metadata.icc_profile) <= MAX_TILE_PROFILE else b""
    profile = Metadata(spec.size, icc_profile=kept)
    eight = replace(spec, dtype=np.dtype(np.uint8), transparent=True, metadata=profile)
    joined = (with_alpha(as_eight_bit(samples), alpha) for samples, alpha in strips)
    sizes = pyramid_sizes(spec.size, 1)
    for number, (size, level) in enumerate(pyramid(sizes, joined, folder.parent, transparent=True), start=1):
        (place := folder / str(len(sizes) - number)).mkdir()
        for row, rows in enumerate(_tile_rows(level, size[1])):
            for column in range(-(-size[0] // TILE)):
                tile = rows[:, slice(*_tile_span(column, size[0]))]
                kind = replace(eight, size=(tile.shape[1], len(tile)))
                with (place / f"{column}_{row}.jpg").open("wb") as stream:
                    stream.writelines(jpeg_pieces(kind, [(np.ascontiguousarray(tile[..., :-1]), tile[..., -1])]))
    description.write_text(
        _DESCRIPTION.format(overlap=OVERLAP, tile=TILE, width=width, height=height), encoding="utf-8"
    )


def read_deep_zoom(path: Path, size: tuple[int, int], side: int) -> UInt8Array:
    """Read the smallest level whose longer side has ``side`` pixels, or else the largest, of an image of ``size``."""
    sizes = pyramid_sizes(size, 1)[::-1]
    level = next((k for k, level_size in enumerate(sizes) if max(level_size) >= side), len(sizes) - 1)
    columns, rows = (range(-(-n // TILE)) for n in sizes[level])
    folder = tiles_folder(path) / str(level)

    def tile(column: int, row: int) -> UInt8Array:
        pixels: UInt8Array = read_image(folder / f"{column}_{row}.jpg").pixels
        return pixels[OVERLAP if row else 0 :][:TILE, OVERLAP if column else 0 :][:, :TILE]

    return np.concatenate([np.concatenate([tile(c, r) for c in columns], axis=1) for r in rows])


def _tile_rows(strips: Iterable[UInt8Array], height: int) -> Iterator[UInt8Array]:
    """Each row of tiles of an image, with their overlap, from its strips."""
    row, top, held = 0, 0, list[UInt8Array]()
    for strip in strips:
        rows = np.concatenate([*held, strip])
        while row * TILE < height and (span := _tile_span(row, height))[1] <= top + len(rows):
            yield rows[span[0] - top : span[1] - top]
            row += 1
            following = max(0, row * TILE - OVERLAP)
            rows, top = rows[following - top :], following
        held = [rows]


def _tile_span(number: int, length: int) -> tuple[int, int]:
    """First and last but one pixel of a tile with its overlap, along one axis of a level."""
    return max(0, number * TILE - OVERLAP), min(length, (number + 1) * TILE + OVERLAP)
