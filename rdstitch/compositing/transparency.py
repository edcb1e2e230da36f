"""What is transparent in an image: filled before it is resampled, and weighted less towards it when blended.

All is computed some rows at a time.
"""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import AnyArray, BoolArray

OPAQUE = 65535  # opacity of what is far from all transparent pixels
OPACITY_BYTES = 2  # bytes of a pixel's opacity
_ROWS = 256
# How far, pixels, samples are certainly those of the nearest opaque pixel: blending reaches so far at an image's own
# scale. Where it reaches farther, these weigh next to nothing, and are of an opaque pixel all the same.
_REACH = 64
# Share of the shorter side over which the weight rises from the border of a mask.
_FEATHER = 0.125


def filled(pixels: AnyArray, opaque: BoolArray) -> AnyArray:
    """Every transparent pixel gets the value of the nearest opaque one, so that no kernel mixes in its colour.

    Far from all opaque pixels it gets that of some opaque one.
    """
    if not opaque.any():
        return pixels
    result, far = pixels.copy(), list[slice]()
    for rows, window in _windows(len(opaque), _REACH):
        if opaque[rows].all():
            continue
        if not opaque[window].any():
            far.append(rows)
            continue
        inner = slice(rows.start - window.start, rows.stop - window.start)
        result[rows] = _from_nearest(pixels[window], opaque[window], inner)
    below = list[slice]()
    for rows in far:
        if rows.start == (below[-1].stop if below else 0):
            below.append(rows)
        else:
            result[rows] = result[rows.start - 1]
    for rows in reversed(below):
        result[rows] = result[rows.stop]
    return result


def opacity(opaque: BoolArray) -> tuple[NDArray[np.uint16], float]:
    """Weight that rises from a mask's border to OPAQUE, and its value at the first opaque pixel, as a share of that."""
    reach = max(2.0, _FEATHER * min(opaque.shape))
    weight = np.empty(opaque.shape, dtype=np.uint16)
    for rows, window in _windows(len(opaque), int(reach) + 1):
        distance = cv2.distanceTransform(opaque[window].view(np.uint8), cv2.DIST_L2, 5)
        within = distance[rows.start - window.start : rows.stop - window.start]
        # Where nothing is transparent distances are beyond all numbers.
        weight[rows] = np.rint(np.minimum(within, np.float32(reach)) * np.float32(OPAQUE / reach))
    return weight, 1.0 / reach


def _windows(height: int, reach: int) -> Iterator[tuple[slice, slice]]:
    """Rows, some at a time, and the same with so many more around them."""
    for top in range(0, height, _ROWS):
        bottom = min(top + _ROWS, height)
        yield slice(top, bottom), slice(max(0, top - reach), min(bottom + reach, height))


def _from_nearest(pixels: AnyArray, opaque: BoolArray, rows: slice) -> AnyArray:
    """Some rows of a part of an image that has opaque pixels, where it is transparent with those of the nearest."""
    hidden = (~opaque).view(np.uint8)
    _, labels = cv2.distanceTransformWithLabels(hidden, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    # The nearest opaque pixel of a transparent one touches a transparent one itself.
    border = np.flatnonzero(cv2.dilate(hidden, np.ones((3, 3), np.uint8)).view(np.bool_) & opaque)
    position = np.zeros(int(labels.max()) + 1, dtype=np.intp)
    position[labels.ravel()[border]] = border
    unseen = ~opaque[rows]
    result = pixels[rows].copy()
    result[unseen] = pixels.reshape(-1, *pixels.shape[2:])[position[labels[rows][unseen]]]
    return result
