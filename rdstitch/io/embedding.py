"""Colour profile, EXIF and resolution as JPEG segments and PNG chunks."""

import struct
import zlib
from collections.abc import Iterator

from rdstitch.io.metadata import Metadata

_EXIF_HEADER = b"Exif\0\0"
_XMP_HEADER = b"http://ns.adobe.com/xap/1.0/\0"
_ICC_HEADER = b"ICC_PROFILE\0"
_MAX_SEGMENT = 65533
_JFIF = 0xE0
_METRES_PER_INCH = 0.0254


def embed_in_jpeg(head: bytes, metadata: Metadata) -> list[bytes]:
    """A JPEG file's beginning with EXIF and XMP (APP1) and ICC profile (APP2) after the JFIF header (APP0).

    EXIF of more than 64 kB does not fit into a JPEG segment and is left out.
    """
    after_header = 2
    jfif = b""
    if head[3] == _JFIF:
        after_header = 4 + struct.unpack_from(">H", head, 4)[0]
        jfif = head[2:after_header]
        if metadata.dpi is not None and all(0 < d < 65535 for d in metadata.dpi):
            jfif = jfif[:11] + struct.pack(">BHH", 1, *(round(d) for d in metadata.dpi)) + jfif[16:]
    exif = bare_exif(metadata)
    segments = [_segment(0xE1, _EXIF_HEADER + exif)] if exif else []
    if metadata.xmp and len(metadata.xmp) + len(_XMP_HEADER) <= _MAX_SEGMENT:
        segments.append(_segment(0xE1, _XMP_HEADER + metadata.xmp))
    return [head[:2], jfif, *segments, *_icc_segments(metadata.icc_profile), head[after_header:]]


def png_metadata_chunks(metadata: Metadata) -> Iterator[bytes]:
    """ICCP, pHYs, eXIf and iTXt chunks, which stand between header and pixels."""
    if metadata.icc_profile:
        yield png_chunk(b"iCCP", b"ICC profile\0\0" + zlib.compress(metadata.icc_profile, 9))
    if metadata.dpi is not None and all(0 < d < 1e6 for d in metadata.dpi):
        yield png_chunk(b"pHYs", struct.pack(">IIB", *(round(d / _METRES_PER_INCH) for d in metadata.dpi), 1))
    if exif := bare_exif(metadata):
        yield png_chunk(b"eXIf", exif)
    if metadata.xmp:
        yield png_chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + metadata.xmp)


def png_chunk(kind: bytes, body: bytes) -> bytes:
    """One PNG chunk."""
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(body, zlib.crc32(kind)))


def bare_exif(metadata: Metadata) -> bytes:
    """EXIF as a TIFF structure, without the header that JPEG puts before it; empty when too large."""
    exif = metadata.exif.removeprefix(_EXIF_HEADER)
    return exif if len(exif) + len(_EXIF_HEADER) + 2 <= _MAX_SEGMENT else b""


def _segment(marker: int, body: bytes) -> bytes:
    """One JPEG marker segment."""
    return struct.pack(">BBH", 0xFF, marker, len(body) + 2) + body


def _icc_segments(profile: bytes) -> Iterator[bytes]:
    """A profile in numbered APP2 segments, since a segment holds 64 kB."""
    room = _MAX_SEGMENT - len(_ICC_HEADER) - 4
    pieces = [profile[k : k + room] for k in range(0, len(profile), room)]
    if len(pieces) <= 255:
        for number, piece in enumerate(pieces, start=1):
            yield _segment(0xE2, _ICC_HEADER + bytes([number, len(pieces)]) + piece)
