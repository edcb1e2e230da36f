"""Colour profile, EXIF and resolution put into encoded JPEG and PNG files, which OpenCV writes without them."""

import struct
import zlib
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rdstitch.io.metadata import Metadata

_EXIF_HEADER = b"Exif\0\0"
_ICC_HEADER = b"ICC_PROFILE\0"
_LARGEST_SEGMENT = 65533
_METRES_PER_INCH = 0.0254


def embed_in_jpeg(data: NDArray[np.uint8], metadata: Metadata) -> list[bytes | memoryview]:
    """The pieces of a JPEG file with EXIF (APP1) and ICC profile (APP2) after the JFIF header (APP0).

    EXIF of more than 64 kB does not fit into a JPEG segment and is left out.
    """
    raw = data.data
    after_header = 2
    jfif = b""
    if bytes(raw[2:4]) == b"\xff\xe0":
        (length,) = struct.unpack(">H", raw[4:6])
        after_header = 4 + length
        jfif = bytes(raw[2:after_header])
        if metadata.dpi is not None and all(0 < d < 65535 for d in metadata.dpi):
            jfif = jfif[:11] + struct.pack(">BHH", 1, *(round(d) for d in metadata.dpi)) + jfif[16:]
    segments = [_segment(0xE1, _EXIF_HEADER + exif) for exif in [_bare_exif(metadata)] if exif]
    return [bytes(raw[:2]), jfif, *segments, *_icc_segments(metadata.icc_profile), raw[after_header:]]


def embed_in_png(data: NDArray[np.uint8], metadata: Metadata) -> list[bytes | memoryview]:
    """The pieces of a PNG file with iCCP, pHYs and eXIf after the header."""
    raw = data.data
    after_header = 33  # signature (8) and IHDR (25)
    chunks = []
    if metadata.icc_profile:
        chunks.append(_chunk(b"iCCP", b"ICC profile\0\0" + zlib.compress(metadata.icc_profile, 9)))
    if metadata.dpi is not None and all(0 < d < 1e6 for d in metadata.dpi):
        per_metre = [round(d / _METRES_PER_INCH) for d in metadata.dpi]
        chunks.append(_chunk(b"pHYs", struct.pack(">IIB", *per_metre, 1)))
    if exif := _bare_exif(metadata):
        chunks.append(_chunk(b"eXIf", exif))
    return [raw[:after_header], *chunks, raw[after_header:]]


def _bare_exif(metadata: Metadata) -> bytes:
    """EXIF as a TIFF structure, without the header that JPEG puts before it; empty when too large."""
    exif = metadata.exif.removeprefix(_EXIF_HEADER)
    return exif if len(exif) + len(_EXIF_HEADER) + 2 <= _LARGEST_SEGMENT else b""


def _segment(marker: int, body: bytes) -> bytes:
    """One JPEG marker segment."""
    return struct.pack(">BBH", 0xFF, marker, len(body) + 2) + body


def _icc_segments(profile: bytes) -> Iterator[bytes]:
    """A profile in numbered APP2 segments, since a segment holds 64 kB."""
    room = _LARGEST_SEGMENT - len(_ICC_HEADER) - 4
    pieces = [profile[k : k + room] for k in range(0, len(profile), room)]
    if len(pieces) <= 255:
        for number, piece in enumerate(pieces, start=1):
            yield _segment(0xE2, _ICC_HEADER + bytes([number, len(pieces)]) + piece)


def _chunk(kind: bytes, body: bytes) -> bytes:
    """One PNG chunk."""
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
