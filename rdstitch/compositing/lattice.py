"""Coordinates and corrections on a lattice of the canvas, interpolated linearly between its nodes."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np

from rdstitch.arrays import Float32Array, FloatArray
from rdstitch.compositing.boxes import Box

LATTICE_STEPS = (32, 16, 8, 4, 2, 1)  # spacings of lattices, canvas pixels; all have the nodes of the first
_NOWHERE = np.float32(-1e6)


@dataclass(frozen=True, eq=False)
class Lattice:
    """Pixels of an image at the nodes of a lattice around a box of the canvas.

    It is anchored to the canvas: every node, and every pixel between them, is the same bit for bit in every box.
    """

    box: Box  # x0, y0, x1, y1, canvas pixels, end exclusive
    step: int  # spacing, one of ``LATTICE_STEPS``
    # (m, n, 2), float32: at the nodes, which enclose the box, those of the widest spacing too; far outside where there
    # are no pixels
    points: Float32Array

    @classmethod
    def over(cls, box: Box, step: int, places: Callable[[FloatArray, FloatArray], FloatArray]) -> Self:
        """Nodes by what maps x (1, n) and y (m, 1), canvas pixels, to pixels (m, n, 2) of an image."""
        (x0, x1), (y0, y1) = _enclosing(box, LATTICE_STEPS[0])
        x, y = (np.arange(start, stop + 1, step, dtype=np.float64) for start, stop in ((x0, x1), (y0, y1)))
        points = places(x[None, :], y[:, None]).astype(np.float32)
        points[~np.isfinite(points).all(axis=-1)] = _NOWHERE
        return cls(box, step, points)

    def nodes(self, box: Box, step: int) -> Float32Array:
        """Pixels at the nodes that enclose a box within this one's, (m, n, 2), at this spacing or a wider one."""
        (x0, x1), (y0, y1) = _enclosing(box, step)
        (left, _), (top, _) = _enclosing(self.box, LATTICE_STEPS[0])
        rows, columns = (
            slice((start - first) // self.step, (stop - first) // self.step + 1, step // self.step)
            for first, start, stop in ((top, y0, y1), (left, x0, x1))
        )
        return self.points[rows, columns]

    def maps(self, box: Box) -> tuple[Float32Array, Float32Array]:
        """Measured pixels of every canvas pixel of a box within this one's: two arrays (h, w)."""
        points = self.nodes(box, self.step)
        return interpolated(points[..., 0], box, self.step), interpolated(points[..., 1], box, self.step)


def interpolated(nodes: Float32Array, box: Box, step: int) -> Float32Array:
    """Linear interpolation of node values (m, n) to the pixels (h, w) of the box that they enclose.

    Every value depends on its four nodes alone, bit for bit, whatever the box.
    """
    x0, y0, x1, y1 = box
    left, top = x0 % step, y0 % step
    fraction = np.arange(step, dtype=np.float32) / np.float32(step)
    rise = nodes[:, 1:] - nodes[:, :-1]
    columns = (rise[..., None] * fraction + nodes[:, :-1, None]).reshape(len(nodes), -1)[:, left : left + x1 - x0]
    values: Float32Array = (columns[1:] - columns[:-1])[:, None, :] * fraction[:, None]
    values += columns[:-1, None, :]
    return np.asarray(values.reshape(-1, x1 - x0)[top : top + y1 - y0])


def _enclosing(box: Box, step: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """First and last node that enclose a box, across and down, canvas pixels."""
    x0, y0, x1, y1 = box
    across, down = ((start // step * step, ((stop - 1) // step + 1) * step) for start, stop in ((x0, x1), (y0, y1)))
    return across, down
