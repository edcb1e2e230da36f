"""Which part of each picture shows in the output, so that no more of it need be held in memory, nor for longer."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.compositing.boxes import Box
from rdstitch.compositing.seam_finder import SeamMap
from rdstitch.compositing.source_images import NOTHING
from rdstitch.compositing.warp import Warp

# By how much the scale may vary over a picture.
_UNEVENNESS = 1.25


@dataclass(frozen=True)
class ShownPart:
    """Where in a picture what it owns of the canvas comes from.

    Attributes
    ----------
    rows : ndarray of shape (K,)
        Rows of the canvas, pixels, ...
    points : ndarray of shape (K, 2)
        ... and places in the picture, pixels: both ends of every run of the seam map that the picture owns.
    room : int
        Pixels of the picture around them that may be requested too.
    size : (int, int)
        Width and height of the picture, pixels.
    """

    rows: FloatArray
    points: FloatArray
    room: int
    size: tuple[int, int]

    def on_rows(self, first: float, last: float) -> bool:
        """Whether it shows on any of these rows of the canvas."""
        return bool(((self.rows >= first) & (self.rows <= last)).any())

    def from_row(self, row: float) -> Box:
        """The part that is needed for the canvas from a row on."""
        points = self.points[self.rows >= row]
        if not len(points):
            return NOTHING
        low, high = np.floor(points.min(axis=0)) - self.room, np.ceil(points.max(axis=0)) + self.room
        limit = np.array(self.size)
        x0, y0, x1, y1 = (int(v) for v in (*np.clip(low, 0, limit - 1), *np.clip(high, 1, limit)))
        return x0, y0, x1, y1


def shown_parts(warps: Sequence[Warp], seams: SeamMap, around: int) -> list[ShownPart]:
    """Where in each picture what it owns comes from.

    Parameters
    ----------
    around : int
        How far from what a picture owns it is requested too, canvas pixels.
    """
    labels, factor, (left, top) = seams.labels, seams.factor, seams.origin
    ends = np.ones((labels.shape[0], labels.shape[1] + 1), dtype=np.bool_)
    ends[:, 1:-1] = labels[:, 1:] != labels[:, :-1]
    # Runs begin after an end and stop before the next.
    rows, columns = np.nonzero(ends[:, :-1])
    first, last = columns, np.nonzero(ends[:, 1:])[1]
    owners = labels[rows, first]
    parts = []
    for index, warp in enumerate(warps):
        own = owners == index
        y = np.tile((rows[own] + top + 0.5) * factor - 0.5, 2)
        x = (np.concatenate([first[own], last[own]]) + left + 0.5) * factor - 0.5
        points = warp.source_points(x, y)
        known = np.isfinite(points).all(axis=1)
        room = math.ceil(_UNEVENNESS * warp.shrink * (around + factor))
        parts.append(ShownPart(y[known], points[known], room, warp.camera.image_size))
    return parts
