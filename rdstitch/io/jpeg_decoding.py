"""JPEG files straight into arrays, whole or at a fraction of their size."""

from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from rdstitch.io.reduction import reduced_size

_SMALLEST = 8  # px a side; below, different reductions give pictures of the same size


def decoded_jpeg(file: Path, size: tuple[int, int], factor: int, *, grey: bool) -> NDArray[Any] | None:
    """Samples (h, w) or (h, w, 3) in RGB order as stored, not turned upright.

    What Pillow would decode, bit for bit, in less time and memory. Pillow has the last word on files about which
    the decoder has any complaint.

    Parameters
    ----------
    file : Path
    size : (int, int)
        Width and height of the whole picture, px.
    factor : int
        1, 2, 4 or 8; so many px a side become one.
    grey : bool

    Returns
    -------
    ndarray or None
        None where something is not as it should be, or the file has no such reduction or is tiny.
    """
    if min(size) < _SMALLEST:
        return None
    width, height = reduced_size(size, factor)
    try:
        samples = simplejpeg.decode_jpeg(
            file.read_bytes(), "GRAY" if grey else "RGB", min_height=height, min_width=width, strict=True
        )
    except ValueError:
        return None
    whole: NDArray[Any] = np.asarray(samples)[..., 0] if grey else np.asarray(samples)
    return whole if whole.shape[:2] == (height, width) else None
