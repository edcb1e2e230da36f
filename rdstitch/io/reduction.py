"""Pictures made smaller by a whole factor, such that px of the small one stand for whole blocks of the large one."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def fitting_reduction(shrink: float) -> int:
    """The largest of the factors 1, 2, 4 and 8, which are cheap for JPEG files, that is no more than ``shrink``."""
    return next((factor for factor in (8, 4, 2) if factor <= shrink), 1)


def reduced_size(size: tuple[int, int], factor: int) -> tuple[int, int]:
    """Width and height, px, of a picture that is reduced by ``factor``; the last block need not be whole."""
    return -(-size[0] // factor), -(-size[1] // factor)


def block_mean(samples: NDArray[Any], factor: int) -> NDArray[Any]:
    """Mean over blocks of ``factor`` x ``factor`` px of samples (h, w) or (h, w, C); borders repeat themselves."""
    if factor == 1:
        return samples
    height, width = samples.shape[:2]
    down, right = -height % factor, -width % factor
    whole = cv2.copyMakeBorder(samples, 0, down, 0, right, cv2.BORDER_REPLICATE) if down or right else samples
    columns, rows = reduced_size((width, height), factor)
    done = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(done).reshape(rows, columns, *samples.shape[2:])


def block_minimum(alpha: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Least value in blocks of ``factor`` x ``factor`` px of a plane (h, w): opaque where all of a block is."""
    if factor == 1:
        return alpha
    height, width = alpha.shape
    whole = np.pad(alpha, [(0, -height % factor), (0, -width % factor)], mode="edge")
    columns, rows = reduced_size((width, height), factor)
    return np.asarray(whole.reshape(rows, factor, columns, factor).min(axis=(1, 3)))
