"""PNG from strips."""

import struct
import zlib
from collections.abc import Iterable, Iterator

import numpy as np

from rdstitch.io.metadata import Metadata
from rdstitch.io.opening import PNG_MAGIC
from rdstitch.io.strips import ImageSpec, Strip, with_alpha
from rdstitch.io.write_jpeg import bare_exif

_METRES_PER_INCH = 0.0254
_COLOUR_TYPES = {(1, False): 0, (3, False): 2, (1, True): 4, (3, True): 6}
_FILTER_SUB = 1
_PNG_LEVEL = 1  # 3 takes twice as long for 3 % less, higher ones several times as long for a few per cent more


def png_pieces(spec: ImageSpec, strips: Iterable[Strip]) -> Iterator[bytes]:
    """The pieces of a PNG file, one strip in memory at a time."""
    kind = _COLOUR_TYPES[spec.channels, spec.transparent]
    yield PNG_MAGIC
    yield png_chunk(b"IHDR", struct.pack(">IIBBBBB", *spec.size, 8 * spec.dtype.itemsize, kind, 0, 0, 0))
    yield from _metadata_chunks(spec.metadata)
    packer, pixel = zlib.compressobj(_PNG_LEVEL), spec.samples_per_pixel * spec.dtype.itemsize
    for samples, alpha in strips:
        shown = with_alpha(samples, alpha) if spec.transparent else samples
        ordered = np.ascontiguousarray(shown.astype(shown.dtype.newbyteorder(">"), copy=False))
        rows = ordered.view(np.uint8).reshape(len(shown), -1)
        filtered = np.empty((len(rows), 1 + rows.shape[1]), dtype=np.uint8)
        filtered[:, 0] = _FILTER_SUB
        filtered[:, 1 : 1 + pixel] = rows[:, :pixel]
        np.subtract(rows[:, pixel:], rows[:, :-pixel], out=filtered[:, 1 + pixel :])
        if packed := packer.compress(filtered.data):
            yield png_chunk(b"IDAT", packed)
    yield png_chunk(b"IDAT", packer.flush())
    yield png_chunk(b"IEND", b"")


def _metadata_chunks(metadata: Metadata) -> Iterator[bytes]:
    """ICCP, pHYs, eXIf and iTXt chunks, which stand between header and pixels."""
    if metadata.icc_profile:
        yield png_chunk(b"iCCP", b"ICC profile\0\0" + zlib.compress(metadata.icc_profile, 9))
    if metadata.resolution is not None:
        yield png_chunk(b"pHYs", struct.pack(">IIB", *(round(d / _METRES_PER_INCH) for d in metadata.resolution), 1))
    if exif := bare_exif(metadata):
        yield png_chunk(b"eXIf", exif)
    if metadata.xmp:
        yield png_chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + metadata.xmp)


def png_chunk(kind: bytes, body: bytes) -> bytes:
    """One PNG chunk."""
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(body, zlib.crc32(kind)))
