"""Tiles of TIFF files: how an image is cut into them, and how each stands in the file."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.system.late_imports import imagecodecs

TILE = 256  # side, pixels
BUFFER = 2**24  # bytes of tiles that tifffile holds before it writes them; 256 MB by default
_LEVEL = 1  # of 1 to 12: 2 takes 1.7 times as long and makes files 2 % smaller


def tiles_of(strips: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """Tiles in the order of the file; those at the right and lower border completed."""
    for strip in strips:
        for y in range(0, strip.shape[0], TILE):
            for x in range(0, strip.shape[1], TILE):
                tile = strip[y : y + TILE, x : x + TILE]
                missing = [(0, TILE - n) for n in tile.shape[:2]] + [(0, 0)]
                yield np.pad(tile, missing) if any(b for _, b in missing) else tile


def has_predictor(dtype: np.dtype[Any]) -> bool:
    """Check whether differences of neighbours are stored; what is usual for floating point, few programs can read."""
    return dtype.kind == "u"


def encoded_tile(tile: NDArray[Any]) -> bytes:
    """A tile (h, w, C) as it stands in the file."""
    stored = tile.copy()
    if has_predictor(tile.dtype):
        stored[:, 1:] -= tile[:, :-1]
    return deflated(stored)


def deflated(stored: NDArray[Any]) -> bytes:
    """Compressed by libdeflate, which is fast, and makes the same bytes of the same samples every time."""
    return bytes(imagecodecs.deflate_encode(stored.tobytes(), _LEVEL))
