"""The eight EXIF orientations: how a stored image is turned and mirrored to be upright.

What belongs to the camera (its lens, its tilt, what hides a part of every image) belongs to the stored frame, and is
turned with it; what people look at is upright.
"""

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray

Number = TypeVar("Number", int, float)

SIDEWAYS = (5, 6, 7, 8)
"""Orientations that exchange the axes, before either of them is reversed."""

_X_BACKWARDS = (2, 3, 6, 7)  # orientations that reverse the first axis
_Y_BACKWARDS = (3, 4, 7, 8)  # orientations that reverse the second
_INVERSES = {6: 8, 8: 6}
_UNMIRRORED = {2: 1, 4: 3, 5: 8, 7: 6}


def inverse(orientation: int) -> int:
    """The orientation that leads from the upright image back to the stored one."""
    return _INVERSES.get(orientation, orientation)


def turned(samples: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Samples (h, w) or (h, w, C) with an orientation (1 to 8) applied; a view."""
    if orientation in SIDEWAYS:
        samples = np.swapaxes(samples, 0, 1)
    if orientation in _Y_BACKWARDS:
        samples = samples[::-1]
    if orientation in _X_BACKWARDS:
        samples = samples[:, ::-1]
    return samples


def turned_size(size: tuple[Number, Number], orientation: int) -> tuple[Number, Number]:
    """Width and height, or what is along them, after :func:`turned`."""
    return (size[1], size[0]) if orientation in SIDEWAYS else size


def turning_matrix(orientation: int) -> FloatArray:
    """What :func:`turned` does to directions in the image, to the right and down, shape (2, 2)."""
    matrix = np.eye(2)[::-1] if orientation in SIDEWAYS else np.eye(2)
    signs = [-1.0 if orientation in backwards else 1.0 for backwards in (_X_BACKWARDS, _Y_BACKWARDS)]
    return np.array(signs)[:, None] * matrix


def quarter_turn(orientation: int) -> int:
    """The orientation without its mirror, which is one of x in the stored frame: 1, 3, 6 or 8."""
    return _UNMIRRORED.get(orientation, orientation)
