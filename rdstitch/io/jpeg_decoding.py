"""JPEG files straight into arrays, whole or at a fraction of their size."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from rdstitch.io.reduction import reduced_size
from rdstitch.regular_files import open_regular

_END_OF_IMAGE = b"\xff\xd9"
_PADDING = re.compile(r"(\d+) extraneous bytes before marker 0xd9")
_MIN_SIDE = 8  # pixels a side; below, different reductions give pictures of the same size


def decoded_jpeg(file: Path, size: tuple[int, int], factor: int, *, grey: bool) -> tuple[NDArray[Any] | None, str]:
    """Samples (h, w) or (h, w, 3) in RGB order as stored, not turned upright, and what is wrong with the file.

    What Pillow would decode, bit for bit, in less time and memory. Pillow has the last word on files about which
    the decoder has any complaint: it refuses some, and decodes others without a word, whatever comes out.

    Parameters
    ----------
    file : Path
    size : (int, int)
        Width and height of the whole picture, pixels.
    factor : int
        1, 2, 4 or 8; so many pixels a side become one.
    grey : bool

    Returns
    -------
    samples : ndarray or None
        None where something is not as it should be, or the file has no such reduction or is tiny.
    complaint : str
        The decoder's; empty where it has none, or one that says nothing of the pixels.
    """
    if min(size) < _MIN_SIDE:
        return None, ""
    width, height = reduced_size(size, factor)
    with open_regular(file) as stream:
        data = stream.read()
    try:
        samples = simplejpeg.decode_jpeg(
            data, "GRAY" if grey else "RGB", min_height=height, min_width=width, strict=True
        )
    except ValueError as error:
        return None, "" if _is_padding(str(error), data) else str(error)
    whole: NDArray[Any] = np.asarray(samples)[..., 0] if grey else np.asarray(samples)
    return (whole if whole.shape[:2] == (height, width) else None), ""


def _is_padding(complaint: str, data: bytes) -> bool:
    """Whether the decoder only complains of zeros before the end, as some cameras write them."""
    found = _PADDING.search(complaint)
    end = data.rfind(_END_OF_IMAGE)
    return found is not None and not data[max(0, end - int(found[1])) : end].strip(b"\0\xff")
