"""PNG of any height from strips, with 8 or 16 bits, grey or colour, with or without alpha."""

import struct
import zlib
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.io.embedding import png_chunk, png_metadata_chunks
from rdstitch.io.layout import Layout, Strip, with_alpha

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_COLOUR_TYPES = {(1, False): 0, (3, False): 2, (1, True): 4, (3, True): 6}
_FILTER_UP = 2
# Higher levels take several times as long for a few per cent.
_LEVEL = 3


def png_pieces(layout: Layout, strips: Iterable[Strip]) -> Iterator[bytes]:
    """The pieces of a PNG file, one strip in memory at a time."""
    kind = _COLOUR_TYPES[layout.channels, layout.transparent]
    yield _SIGNATURE
    yield png_chunk(b"IHDR", struct.pack(">IIBBBBB", *layout.size, 8 * layout.dtype.itemsize, kind, 0, 0, 0))
    yield from png_metadata_chunks(layout.metadata)
    packer = zlib.compressobj(_LEVEL)
    above = np.zeros(layout.size[0] * layout.samples_per_pixel * layout.dtype.itemsize, dtype=np.uint8)
    for samples, alpha in strips:
        rows = _bytes_of_rows(with_alpha(samples, alpha) if layout.transparent else samples)
        filtered = np.empty((len(rows), rows.shape[1] + 1), dtype=np.uint8)
        filtered[:, 0] = _FILTER_UP
        np.subtract(rows[0], above, out=filtered[0, 1:])
        np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])
        above = rows[-1].copy()
        if packed := packer.compress(filtered.data):
            yield png_chunk(b"IDAT", packed)
    yield png_chunk(b"IDAT", packer.flush())
    yield png_chunk(b"IEND", b"")


def _bytes_of_rows(samples: NDArray[Any]) -> NDArray[np.uint8]:
    """Rows as bytes, big-endian."""
    ordered = np.ascontiguousarray(samples.astype(samples.dtype.newbyteorder(">"), copy=False))
    return ordered.view(np.uint8).reshape(len(samples), -1)
