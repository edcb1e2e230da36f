"""The picture at full, half, quarter … size, each pixel the mean of four of the level above.

Box filters of twice the size, sampled at every second pixel, are the same filters on the picture of half the size.
So an octave of SURF is the first octave on the next level, and needs neither large filters nor their own code.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray

Grey = NDArray[np.uint8]


def pyramid(grey: Grey, levels: int) -> list[Grey]:
    """At most ``levels`` levels, the picture itself first; an odd last row or column is left out of the next."""
    result = [grey]
    while len(result) < levels and min(result[-1].shape) >= 4:
        height, width = result[-1].shape
        even = result[-1][: height // 2 * 2, : width // 2 * 2]
        result.append(np.asarray(cv2.resize(even, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.uint8))
    return result


def to_level(points: FloatArray, level: int) -> FloatArray:
    """Pixels of the picture to pixels of a level; (0, 0) is the centre of the first pixel in both."""
    return (points + 0.5) / float(2**level) - 0.5


def from_level(points: FloatArray, level: int) -> FloatArray:
    """Pixels of a level to pixels of the picture."""
    return (points + 0.5) * float(2**level) - 0.5
