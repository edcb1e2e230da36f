"""JPEG from strips, whose scans are joined at restart markers, where nothing is carried over."""

import struct
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from rdstitch.arrays import AnyArray, UInt8Array
from rdstitch.errors import LimitError
from rdstitch.io.metadata import Metadata
from rdstitch.io.strips import ImageSpec, Strip, as_eight_bit
from rdstitch.system.ahead import in_order_ahead

_ENCODERS = 2  # threads at the most: each has a strip in memory, and keeps up with ten workers that make strips
_EXIF_HEADER = b"Exif\0\0"
_XMP_HEADER = b"http://ns.adobe.com/xap/1.0/\0"
_ICC_HEADER = b"ICC_PROFILE\0"
_MAX_SEGMENT = 65533
_JFIF = 0xE0
_END_OF_IMAGE = b"\xff\xd9"
# Markers RST0 to RST7 take turns; a strip of a multiple of 8 rows of blocks ends where RST7 is due.
_RESTART_7 = b"\xff\xd7"
_START_OF_FRAME, _START_OF_SCAN = 0xC0, 0xDA
_BLOCK_GREY, _BLOCK_COLOUR = 8, 16


def jpeg_pieces(spec: ImageSpec, strips: Iterable[Strip], workers: int = 1) -> Iterator[bytes | memoryview]:
    """The pieces of a JPEG file, three strips in memory at a time; transparency becomes the background."""
    first = True
    for data in _encoded(spec, strips, workers):
        scan = _segment_end(data, _segment_of(data, _START_OF_SCAN))
        if first:
            yield from _embedded(_with_height(data[:scan], spec.size[1]), spec.metadata)
        else:
            yield _RESTART_7
        yield memoryview(data)[scan : -len(_END_OF_IMAGE)]
        first = False
    yield _END_OF_IMAGE


def _encoded(spec: ImageSpec, strips: Iterable[Strip], workers: int) -> Iterator[bytes]:
    """Each strip as a JPEG file; with several workers, beside what makes the next strips."""
    if workers == 1:
        yield from (_jpeg(spec, *strip) for strip in strips)
        return
    with ThreadPoolExecutor(min(workers, _ENCODERS)) as pool:
        yield from in_order_ahead(pool, lambda strip: _jpeg(spec, *strip), strips, _ENCODERS)


def _jpeg(spec: ImageSpec, samples: AnyArray, alpha: UInt8Array | None) -> bytes:
    """One strip as a JPEG file of its own, with a restart marker after each row of blocks."""
    eight = as_eight_bit(samples)
    if spec.channels == 1:
        block, image = _BLOCK_GREY, eight[..., 0].copy()
    else:
        block, image = _BLOCK_COLOUR, np.asarray(cv2.cvtColor(eight, cv2.COLOR_RGB2BGR))
    if alpha is not None and not alpha.all():
        image = np.asarray(cv2.bitwise_and(image, image, mask=alpha), dtype=np.uint8)
        if spec.background:
            image[alpha == 0] = spec.background
    options = [
        *(cv2.IMWRITE_JPEG_QUALITY, spec.quality),
        *(cv2.IMWRITE_JPEG_RST_INTERVAL, -(-spec.size[0] // block)),
        *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420),
    ]
    done, data = cv2.imencode(".jpg", image, options)
    if not done:
        raise LimitError(f"{spec.size[0]} x {spec.size[1]} pixels cannot be encoded as JPEG; write a .tif")
    return np.asarray(data, dtype=np.uint8).tobytes()


def _with_height(head: bytes, height: int) -> bytes:
    """The header with the height of the whole image instead of the first strip's."""
    position = _segment_of(head, _START_OF_FRAME)
    # Marker (2), length (2), precision (1), then the height.
    return head[: position + 5] + struct.pack(">H", height) + head[position + 7 :]


def _segment_of(data: bytes, marker: int) -> int:
    """Where a header's segment with a marker begins."""
    position = 2
    while data[position + 1] != marker:
        position = _segment_end(data, position)
    return position


def _segment_end(data: bytes, position: int) -> int:
    end: int = position + 2 + struct.unpack_from(">H", data, position + 2)[0]
    return end


def _embedded(head: bytes, metadata: Metadata) -> list[bytes]:
    """A JPEG file's beginning with EXIF and XMP (APP1) and ICC profile (APP2) after the JFIF header (APP0).

    EXIF of more than 64 kB does not fit into a JPEG segment and is left out.
    """
    after_header = 2
    jfif = b""
    if head[3] == _JFIF:
        after_header = _segment_end(head, after_header)
        jfif = head[2:after_header]
        if metadata.resolution is not None and max(metadata.resolution) < 65535:
            jfif = jfif[:11] + struct.pack(">BHH", 1, *(round(d) for d in metadata.resolution)) + jfif[16:]
    exif = bare_exif(metadata)
    segments = [_segment(0xE1, _EXIF_HEADER + exif)] if exif else []
    if metadata.xmp and len(metadata.xmp) + len(_XMP_HEADER) <= _MAX_SEGMENT:
        segments.append(_segment(0xE1, _XMP_HEADER + metadata.xmp))
    return [head[:2], jfif, *segments, *_icc_segments(metadata.icc_profile), head[after_header:]]


def bare_exif(metadata: Metadata) -> bytes:
    """EXIF as a TIFF structure, without the header that JPEG puts before it; empty when too large."""
    exif = metadata.exif.removeprefix(_EXIF_HEADER)
    return exif if len(exif) + len(_EXIF_HEADER) + 2 <= _MAX_SEGMENT else b""


def _segment(marker: int, body: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, len(body) + 2) + body


def _icc_segments(profile: bytes) -> Iterator[bytes]:
    """A profile in numbered APP2 segments, since a segment holds 64 kB."""
    room = _MAX_SEGMENT - len(_ICC_HEADER) - 4
    pieces = [profile[k : k + room] for k in range(0, len(profile), room)]
    if len(pieces) <= 255:
        for number, piece in enumerate(pieces, start=1):
            yield _segment(0xE2, _ICC_HEADER + bytes([number, len(pieces)]) + piece)
