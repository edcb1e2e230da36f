"""Decoding JPEG, whole or at a share of its size, faster than Pillow does."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from rdstitch.io.reduction import reduced_size
from rdstitch.system.file_access import read_beginning

_END_OF_IMAGE = b"\xff\xd9"
_PADDING = re.compile(r"(\d+) extraneous bytes before marker 0xd9")
_MIN_SIDE = 8  # pixels; below, different reductions give images of the same size


def decoded_jpeg(file: Path, size: tuple[int, int], factor: int, *, grey: bool) -> tuple[NDArray[Any] | None, str]:
    """Samples of 1/``factor`` of the size, (h, w) or (h, w, 3) in RGB order as stored, and what is wrong with the file.

    What Pillow would decode, bit for bit, in less time and memory. Pillow has the last word on files about which
    the decoder has any complaint: it refuses some, and decodes others without a word, whatever comes out. Then, and
    where the file has no such reduction or is tiny, there are no samples; complaints that say nothing of the pixels
    are empty.
    """
    if min(size) < _MIN_SIDE:
        return None, ""
    width, height = reduced_size(size, factor)
    data = read_beginning(file, most_bytes(size))
    try:
        samples = simplejpeg.decode_jpeg(
            data, "GRAY" if grey else "RGB", min_height=height, min_width=width, strict=True
        )
    except ValueError as error:
        return None, "" if _is_padding(str(error), data) else str(error)
    whole: NDArray[Any] = np.asarray(samples)[..., 0] if grey else np.asarray(samples)
    return (whole if whole.shape[:2] == (height, width) else None), ""


def most_bytes(size: tuple[int, int]) -> int:
    """How much of a file an image can take, with what stands before it; a video may follow, or a hole without end."""
    return 2**26 + 16 * size[0] * size[1]


def _is_padding(complaint: str, data: bytes) -> bool:
    """Check whether the decoder only complains of zeros before the end, as some cameras write them."""
    padding = _PADDING.search(complaint)
    end = data.rfind(_END_OF_IMAGE)
    return padding is not None and not data[max(0, end - int(padding[1])) : end].strip(b"\0\xff")
