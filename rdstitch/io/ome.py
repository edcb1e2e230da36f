"""OME-TIFF with a pyramid from strips: channels on pages of their own, and the size of a pixel."""

import tempfile
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.io.layout import STRIP_ROWS, Layout, Strip
from rdstitch.io.reduction import halved
from rdstitch.io.tiff import TILE, encoded_tile, has_predictor, overview_sizes, tiles_of
from rdstitch.late_imports import tifffile

SUFFIXES = (".ome.tif", ".ome.tiff")


def write_ome_tiff(path: Path, layout: Layout, strips: Iterable[Strip]) -> None:
    """Write an OME-TIFF file with a pyramid; what no image covers is 0.

    Channels become pages; those of a colour image stay together.
    """
    sizes = [layout.size, *overview_sizes(layout.size)]
    apart = layout.metadata.planes or layout.channels != 3
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        levels: list[NDArray[Any]] = []
        for number, (width, height) in enumerate(sizes):
            level = np.memmap(Path(folder) / str(number), layout.dtype, "w+", shape=(height, width, layout.channels))
            _fill(level, strips if number == 0 else _halves(levels[-1]))
            levels.append(level)
        size = layout.metadata.pixel_size
        units = {} if size is None else {"PhysicalSizeX": size, "PhysicalSizeY": size}
        names = {key + "Unit": "µm" for key in units}
        identity = uuid.uuid5(uuid.NAMESPACE_OID, f"rdstitch {layout.size} {layout.channels} {layout.dtype}")
        total = sum(level.nbytes for level in levels)
        with tifffile.TiffWriter(path, ome=True, bigtiff=total > 2**31) as tiff:
            for number, pixels in enumerate(levels):
                height, width, channels = pixels.shape
                parts = [pixels[..., k : k + 1] for k in range(channels)] if apart else [pixels]
                tiff.write(
                    (encoded_tile(tile) for part in parts for tile in tiles_of(_strips(part))),
                    shape=(channels, height, width) if apart else (height, width, channels),
                    dtype=layout.dtype,
                    photometric="minisblack" if apart else "rgb",
                    planarconfig=None if apart else "contig",
                    tile=(TILE, TILE),
                    compression="zlib",
                    predictor=has_predictor(layout.dtype),
                    subifds=None if number else len(levels) - 1,
                    subfiletype=1 if number else 0,
                    metadata=None
                    if number
                    else {"axes": "CYX" if apart else "YXS", "UUID": f"urn:uuid:{identity}", **units, **names},
                    software="rdstitch",
                )


def _fill(level: NDArray[Any], strips: Iterable[Strip]) -> None:
    top = 0
    for samples, alpha in strips:
        rows = level[top : top + len(samples)]
        rows[...] = samples if alpha is None else np.where(alpha[..., None] > 0, samples, samples.dtype.type(0))
        top += len(samples)


def _strips(level: NDArray[Any]) -> Iterator[NDArray[Any]]:
    for top in range(0, len(level), STRIP_ROWS):
        yield np.ascontiguousarray(level[top : top + STRIP_ROWS])


def _halves(level: NDArray[Any]) -> Iterator[Strip]:
    for strip in _strips(level):
        yield halved(strip, False), None
