"""EXIF orientation: how a stored picture must be turned to be seen as it was taken."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

SIDEWAYS = (5, 6, 7, 8)
"""Orientations that exchange the axes; what runs backwards, runs so after that."""

_X_BACKWARDS, _Y_BACKWARDS = (2, 3, 6, 7), (3, 4, 7, 8)


def turned(samples: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Samples (h, w) or (h, w, C) with an orientation (1 to 8) applied; a view."""
    if orientation in SIDEWAYS:
        samples = np.swapaxes(samples, 0, 1)
    if orientation in _Y_BACKWARDS:
        samples = samples[::-1]
    if orientation in _X_BACKWARDS:
        samples = samples[:, ::-1]
    return samples


def turned_direction(x: float, y: float, orientation: int) -> tuple[float, float]:
    """A direction in a stored picture, to the right and down, as it is after :func:`turned`."""
    if orientation in SIDEWAYS:
        x, y = y, x
    return (-x if orientation in _X_BACKWARDS else x), (-y if orientation in _Y_BACKWARDS else y)
