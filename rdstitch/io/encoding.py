"""What is written, an image in strips from top to bottom, and again half as large; JPEG and PNG of such strips.

The scans of JPEG strips are joined at restart markers, where nothing is carried over.
"""

import struct
import tempfile
import zlib
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.errors import ArgumentError, LimitError
from rdstitch.io.metadata import Metadata
from rdstitch.io.opening import PNG_MAGIC
from rdstitch.io.reduction import halved, reduced_size

# Samples (h, W, C) and alpha (h, W), uint8, or None for opaque.
Strip = tuple[NDArray[Any], NDArray[np.uint8] | None]

# Strips but the last have a multiple of this many rows: what JPEG (128) and TIFF tiles (256) need.
STRIP_ROWS = 256
_ENCODERS = 2  # threads at the most: each has a strip in memory, and keeps up with ten workers that make strips
_HALVED_ROWS = 32  # that are reduced at a time, even

_EXIF_HEADER = b"Exif\0\0"
_XMP_HEADER = b"http://ns.adobe.com/xap/1.0/\0"
_ICC_HEADER = b"ICC_PROFILE\0"
_MAX_SEGMENT = 65533
_JFIF = 0xE0
_METRES_PER_INCH = 0.0254
_END_OF_IMAGE = b"\xff\xd9"
# Markers RST0 to RST7 take turns; a strip of a multiple of 8 rows of blocks ends where RST7 is due.
_RESTART_7 = b"\xff\xd7"

_START_OF_FRAME, _START_OF_SCAN = 0xC0, 0xDA
_BLOCK_GREY, _BLOCK_COLOUR = 8, 16
_COLOUR_TYPES = {(1, False): 0, (3, False): 2, (1, True): 4, (3, True): 6}
_FILTER_SUB = 1
# Level 3 takes twice as long for 3 % less, higher ones several times as long for a few per cent more.
_PNG_LEVEL = 1


@dataclass(frozen=True)
class ImageSpec:
    """The form of an image that comes in strips."""

    size: tuple[int, int]  # width and height, pixels
    channels: int  # colour channels, without alpha
    dtype: np.dtype[Any]  # uint8, uint16 or float32
    transparent: bool = False  # whether there is an alpha channel, if the format can hold one
    metadata: Metadata = field(default_factory=lambda: Metadata((1, 1)))  # colour profile, EXIF and resolution to keep
    quality: int = 95  # of JPEG and WebP, 1 to 100
    background: int = 0  # grey (0 to 255) of what is transparent, in a format without transparency

    def __post_init__(self) -> None:
        if min(self.size) < 1 or self.channels < 1:
            raise ArgumentError(
                f"an image of {self.size[0]} x {self.size[1]} pixels and {self.channels} channels is empty"
            )
        if self.dtype not in (np.uint8, np.uint16, np.float32):
            raise ArgumentError(f"pixels must be uint8, uint16 or float32, not {self.dtype}")

    @property
    def samples_per_pixel(self) -> int:
        """Channels with alpha."""
        return self.channels + self.transparent


def check_strips(spec: ImageSpec, strips: Iterable[Strip]) -> Iterator[Strip]:
    """The strips, when they are what the spec says."""
    width, height = spec.size
    rows = 0
    for samples, alpha in strips:
        if samples.shape[1:] != (width, spec.channels) or samples.dtype != spec.dtype:
            raise ArgumentError(f"a strip of {samples.dtype} {samples.shape} does not fit into {spec.size}")
        if alpha is not None and (alpha.shape != samples.shape[:2] or alpha.dtype != np.uint8):
            raise ArgumentError(f"alpha must be uint8 of shape {samples.shape[:2]}, not {alpha.dtype} {alpha.shape}")
        if rows % STRIP_ROWS:
            raise ArgumentError(f"strips but the last must have a multiple of {STRIP_ROWS} rows")
        rows += len(samples)
        yield samples, alpha
    if rows != height:
        raise ArgumentError(f"{rows} of {height} rows were given")


def as_eight_bit(samples: NDArray[Any]) -> NDArray[np.uint8]:
    """16 bits rounded to 8."""
    if samples.dtype == np.uint8:
        return np.asarray(samples, dtype=np.uint8)
    return ((samples.astype(np.uint32) + 128) // 257).astype(np.uint8)


def with_alpha(samples: NDArray[Any], alpha: NDArray[np.uint8] | None) -> NDArray[Any]:
    """Samples (h, W, C) with alpha as one channel more, in the samples' type."""
    full = np.iinfo(samples.dtype).max if samples.dtype.kind == "u" else 1.0
    if alpha is None:
        opacity = np.full(samples.shape[:2], full, dtype=samples.dtype)
    else:
        opacity = alpha * samples.dtype.type(full / 255)
    # numpy is slow along an axis of three.
    return np.asarray(cv2.merge([samples, opacity]))


def pyramid_sizes(size: tuple[int, int], smallest: int) -> list[tuple[int, int]]:
    """Width and height of an image and of its reductions, each half of the one before, down to a longer side."""
    sizes = [size]
    while max(sizes[-1]) > smallest:
        sizes.append(reduced_size(sizes[-1], 2))
    return sizes


def pyramid(
    sizes: list[tuple[int, int]], strips: Iterable[NDArray[Any]], folder: Path, *, transparent: bool
) -> Iterator[tuple[tuple[int, int], Iterator[NDArray[Any]]]]:
    """Each size of an image with strips (h, w, C) of it, which are taken one size after the other, to their ends.

    The smaller image is made while strips pass, and waits in a temporary file in a folder until its turn; memory is
    that of one strip. Where the image is transparent, the last channel is alpha.
    """
    with ExitStack() as stack:
        for size, smaller in zip(sizes, [*sizes[1:], None], strict=True):
            spill = None if smaller is None else stack.enter_context(tempfile.TemporaryFile(dir=folder))
            kind: list[NDArray[Any]] = []
            yield size, _spilling(strips, spill, kind, transparent)
            if spill is not None and smaller is not None:
                strips = _reread(spill, smaller, kind[0])


def _spilling(
    strips: Iterable[NDArray[Any]], spill: IO[bytes] | None, kind: list[NDArray[Any]], transparent: bool
) -> Iterator[NDArray[Any]]:
    """The strips; what passes is also written, half as large, to a file, and a pixel of it kept in ``kind``."""
    for strip in strips:
        # Before it is passed on: a writer does not come back after the last tile.
        if spill is not None:
            kind[:] = [strip[0, 0]]
            for top in range(0, len(strip), _HALVED_ROWS):
                spill.write(halved(strip[top : top + _HALVED_ROWS], transparent).data)
        yield strip


def _reread(spill: IO[bytes], size: tuple[int, int], kind: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Strips from a file of plain samples, which is closed afterwards."""
    width, height = size
    spill.seek(0)
    for top in range(0, height, STRIP_ROWS):
        rows = min(STRIP_ROWS, height - top)
        samples = np.frombuffer(spill.read(rows * width * kind.nbytes), dtype=kind.dtype)
        yield samples.reshape(rows, width, len(kind))
    spill.close()


def jpeg_pieces(spec: ImageSpec, strips: Iterable[Strip], workers: int = 1) -> Iterator[bytes | memoryview]:
    """The pieces of a JPEG file, three strips in memory at a time; transparency becomes the background.

    ``workers``: threads that may encode.
    """
    first = True
    for data in _encoded(spec, strips, workers):
        head, scan = _header_and_scan(data)
        if first:
            yield from _embedded(_with_height(head, spec.size[1]), spec.metadata)
        else:
            yield _RESTART_7
        yield scan
        first = False
    yield _END_OF_IMAGE


def _encoded(spec: ImageSpec, strips: Iterable[Strip], workers: int) -> Iterator[bytes]:
    """Each strip as a JPEG file; with several workers, beside what makes the next strips."""
    if workers == 1:
        yield from (_jpeg(spec, *strip) for strip in strips)
        return
    with ThreadPoolExecutor(min(workers, _ENCODERS)) as pool:
        under_way: deque[Future[bytes]] = deque()
        for strip in strips:
            under_way.append(pool.submit(_jpeg, spec, *strip))
            if len(under_way) > _ENCODERS:
                yield under_way.popleft().result()
        while under_way:
            yield under_way.popleft().result()


def _jpeg(spec: ImageSpec, samples: NDArray[np.generic], alpha: NDArray[np.uint8] | None) -> bytes:
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


def _header_and_scan(data: bytes) -> tuple[bytes, memoryview]:
    """Everything up to the scan, and the scan without the end marker."""
    position = 2
    while data[position + 1] != _START_OF_SCAN:
        position += 2 + struct.unpack_from(">H", data, position + 2)[0]
    position += 2 + struct.unpack_from(">H", data, position + 2)[0]
    return data[:position], memoryview(data)[position : -len(_END_OF_IMAGE)]


def _with_height(head: bytes, height: int) -> bytes:
    """The header with the height of the whole image instead of the first strip's."""
    position = 2
    while head[position + 1] != _START_OF_FRAME:
        position += 2 + struct.unpack_from(">H", head, position + 2)[0]
    # Marker (2), length (2), precision (1), then the height.
    return head[: position + 5] + struct.pack(">H", height) + head[position + 7 :]


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


def _embedded(head: bytes, metadata: Metadata) -> list[bytes]:
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
    exif = _bare_exif(metadata)
    segments = [_segment(0xE1, _EXIF_HEADER + exif)] if exif else []
    if metadata.xmp and len(metadata.xmp) + len(_XMP_HEADER) <= _MAX_SEGMENT:
        segments.append(_segment(0xE1, _XMP_HEADER + metadata.xmp))
    return [head[:2], jfif, *segments, *_icc_segments(metadata.icc_profile), head[after_header:]]


def _metadata_chunks(metadata: Metadata) -> Iterator[bytes]:
    """ICCP, pHYs, eXIf and iTXt chunks, which stand between header and pixels."""
    if metadata.icc_profile:
        yield png_chunk(b"iCCP", b"ICC profile\0\0" + zlib.compress(metadata.icc_profile, 9))
    if metadata.dpi is not None and all(0 < d < 1e6 for d in metadata.dpi):
        yield png_chunk(b"pHYs", struct.pack(">IIB", *(round(d / _METRES_PER_INCH) for d in metadata.dpi), 1))
    if exif := _bare_exif(metadata):
        yield png_chunk(b"eXIf", exif)
    if metadata.xmp:
        yield png_chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + metadata.xmp)


def png_chunk(kind: bytes, body: bytes) -> bytes:
    """One PNG chunk."""
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(body, zlib.crc32(kind)))


def _bare_exif(metadata: Metadata) -> bytes:
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
