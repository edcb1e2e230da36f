"""Where pictures meet, as a small transparent picture."""

import io

import numpy as np
from PIL import Image

from rdstitch.compositing.seam_finder import SeamMap

_COLOUR = (0, 229, 255)


def seam_picture(
    seams: SeamMap, origin: tuple[int, int], size: tuple[int, int]
) -> tuple[bytes, tuple[float, float, float, float]]:
    """Seams as PNG, and the box (x, y, width, height) that it fills, pixels of the mosaic from its corner.

    Parameters
    ----------
    seams : SeamMap
    origin, size : (int, int)
        Where the mosaic begins in the canvas of the seams, and how large it is, pixels.
    """
    labels, factor = seams.labels, seams.factor
    left, top = origin[0] // factor, origin[1] // factor
    right, bottom = -(-(origin[0] + size[0]) // factor), -(-(origin[1] + size[1]) // factor)
    labels = labels[top:bottom, left:right]
    meets = np.zeros(labels.shape, dtype=bool)
    for axis in (0, 1):
        first = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
        second = (slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))
        # Where a picture ends at nothing there is no seam.
        meets[first] |= (labels[first] != labels[second]) & (labels[first] >= 0) & (labels[second] >= 0)
    samples = np.zeros((*labels.shape, 4), dtype=np.uint8)
    samples[meets] = (*_COLOUR, 255)
    stream = io.BytesIO()
    Image.fromarray(samples).save(stream, "PNG", optimize=True)
    x, y = float(left * factor - origin[0]), float(top * factor - origin[1])
    return stream.getvalue(), (x, y, float(labels.shape[1] * factor), float(labels.shape[0] * factor))
