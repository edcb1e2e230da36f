"""JPEG of any height from strips: the strips' scans are joined at restart markers, where nothing is carried over."""

import struct
from collections.abc import Iterable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.errors import LimitError
from rdstitch.io.embedding import embed_in_jpeg
from rdstitch.io.layout import Layout, Strip, as_eight_bit

_END_OF_IMAGE = b"\xff\xd9"
# Markers RST0 to RST7 take turns; a strip of a multiple of 8 rows of blocks ends where RST7 is due.
_RESTART_7 = b"\xff\xd7"
_START_OF_FRAME, _START_OF_SCAN = 0xC0, 0xDA
_BLOCK_GREY, _BLOCK_COLOUR = 8, 16


def jpeg_pieces(layout: Layout, strips: Iterable[Strip]) -> Iterator[bytes | memoryview]:
    """The pieces of a JPEG file, one strip in memory at a time; transparency becomes the background."""
    first = True
    for samples, alpha in strips:
        head, scan = _split(_encoded(layout, samples, alpha))
        if first:
            yield from embed_in_jpeg(_with_height(head, layout.size[1]), layout.metadata)
        else:
            yield _RESTART_7
        yield scan
        first = False
    yield _END_OF_IMAGE


def _encoded(layout: Layout, samples: NDArray[np.generic], alpha: NDArray[np.uint8] | None) -> bytes:
    """One strip as a JPEG file of its own, with a restart marker after each row of blocks."""
    eight = as_eight_bit(samples)
    if layout.channels == 1:
        block, picture = _BLOCK_GREY, eight[..., 0].copy()
    else:
        block, picture = _BLOCK_COLOUR, np.asarray(cv2.cvtColor(eight, cv2.COLOR_RGB2BGR))
    if alpha is not None and not alpha.all():
        picture = _on_background(picture, alpha, layout.background)
    options = [
        *(cv2.IMWRITE_JPEG_QUALITY, layout.quality),
        *(cv2.IMWRITE_JPEG_RST_INTERVAL, -(-layout.size[0] // block)),
        *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420),
    ]
    done, data = cv2.imencode(".jpg", picture, options)
    if not done:
        raise LimitError(f"{layout.size[0]} x {layout.size[1]} pixels cannot be encoded as JPEG; write a .tif")
    return np.asarray(data, dtype=np.uint8).tobytes()


def _on_background(picture: NDArray[np.uint8], alpha: NDArray[np.uint8], background: int) -> NDArray[np.uint8]:
    """A picture (h, w) or (h, w, 3), grey where alpha is 0."""
    shown = cv2.bitwise_and(picture, picture, mask=alpha)
    if background:
        shown[alpha == 0] = background
    return np.asarray(shown, dtype=np.uint8)


def _split(data: bytes) -> tuple[bytes, memoryview]:
    """Everything up to the scan, and the scan without the end marker."""
    position = 2
    while data[position + 1] != _START_OF_SCAN:
        position += 2 + struct.unpack_from(">H", data, position + 2)[0]
    position += 2 + struct.unpack_from(">H", data, position + 2)[0]
    return data[:position], memoryview(data)[position : -len(_END_OF_IMAGE)]


def _with_height(head: bytes, height: int) -> bytes:
    """The header with the height of the whole picture instead of the first strip's."""
    position = 2
    while head[position + 1] != _START_OF_FRAME:
        position += 2 + struct.unpack_from(">H", head, position + 2)[0]
    # Marker (2), length (2), precision (1), then the height.
    return head[: position + 5] + struct.pack(">H", height) + head[position + 7 :]
