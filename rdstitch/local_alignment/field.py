"""A smooth displacement field over one image: a bicubic spline through displacements on a coarse grid."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.system.late_imports import ndimage

_DECIMALS = 3  # pixels; what a sidecar stores is what was used
# Nodes by which a field goes on as it does at the border, so that a spline, which is level at its end, is so beyond it.
_APRON = 8
# Nodes beyond the border up to which it is evaluated: who interpolates across the border would find a kink there, and
# take many times as many places for it.
_BEYOND = 4
_EDGE_POINTS = 9  # at which a bent edge is measured
_PROBES = 4  # of the steepness, along a side of a cell


@dataclass(frozen=True, eq=False)
class DisplacementField:
    """Displacements of one image.

    What the alignment expects at the measured pixels ``q`` is at ``q + field(q)``.
    """

    image_size: tuple[int, int]  # width and height of the image, pixels
    # (m, n, 2): displacement, pixels, at nodes spread evenly from the first to the last pixel of each row and column, m
    # rows of n
    values: FloatArray

    def __post_init__(self) -> None:
        if self.values.ndim != 3 or self.values.shape[2] != 2 or min(self.values.shape[:2]) < 2:
            raise ArgumentError(
                f"a displacement field has shape (m, n, 2), m and n at least 2, not {self.values.shape}"
            )
        if not np.isfinite(self.values).all():
            raise ArgumentError("displacements must be finite")

    @classmethod
    def of(cls, image_size: tuple[int, int], values: FloatArray) -> Self:
        """A field with values rounded as a sidecar stores them."""
        return cls(image_size, np.round(values, _DECIMALS) + 0.0)

    def __call__(self, points: FloatArray) -> FloatArray:
        """Displacement (..., 2) at measured pixels (..., 2), also beside the image; far out as there, 0 at NaN."""
        place = np.moveaxis(self._grid_coordinates(points), -1, 0)[::-1] + _APRON
        return np.stack([ndimage.map_coordinates(c, place, order=3, mode="mirror", prefilter=False)
                         for c in self._coefficients], axis=-1)  # fmt: skip

    def resized(self, image_size: tuple[int, int]) -> "DisplacementField":
        """The same for an image of another size that shows the same."""
        ratio = np.array(image_size, dtype=np.float64) / self.image_size
        return DisplacementField(image_size, self.values * ratio)

    @cached_property
    def largest(self) -> float:
        """Length of the largest displacement of a node, pixels."""
        return float(np.linalg.norm(self.values, axis=-1).max())

    @cached_property
    def steepest(self) -> float:
        """Largest change of the displacement per pixel in any direction; below 1 the image does not fold."""
        rows, columns = (_PROBES * (n - 1) + 1 for n in self.values.shape[:2])
        moved = self(node_points(self.image_size, (rows, columns))).reshape(rows, columns, 2)
        spacing = (np.array(self.image_size) - 1.0) / (columns - 1, rows - 1)
        across, down = np.diff(moved, axis=1)[:-1] / spacing[0], np.diff(moved, axis=0)[:, :-1] / spacing[1]
        return float(np.linalg.norm(np.stack([across, down], axis=-1), ord=2, axis=(-2, -1)).max())

    def bends(self, edges: FloatArray) -> FloatArray:
        """How far straight edges with such ends (K, 2, 2) are bent, measured pixels (K,)."""
        share = np.linspace(0.0, 1.0, _EDGE_POINTS)[:, None, None]
        moved = self(edges[:, 0] + share * (edges[:, 1] - edges[:, 0]))
        along = edges[:, 1] - edges[:, 0]
        normal = np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.linalg.norm(along, axis=1, keepdims=True)
        off = moved - (moved[0] + share * (moved[-1] - moved[0]))
        return np.asarray(np.abs((off * normal).sum(axis=-1)).max(axis=0))

    @cached_property
    def _coefficients(self) -> list[FloatArray]:
        around = [(_APRON, _APRON)] * 2
        padded = [np.pad(self.values[..., k], around, mode="reflect", reflect_type="odd") for k in (0, 1)]
        return [ndimage.spline_filter(values, order=3, mode="mirror") for values in padded]

    def _grid_coordinates(self, points: FloatArray) -> FloatArray:
        """Column and row (..., 2) in units of the grid, within it or not far from it."""
        last = np.array([self.values.shape[1] - 1, self.values.shape[0] - 1])
        place = np.asarray(points, dtype=np.float64) * (last / (np.array(self.image_size) - 1.0))
        return np.clip(np.nan_to_num(place), -_BEYOND, last + _BEYOND)


def bilinear(
    points: FloatArray, image_size: tuple[int, int], shape: Sequence[int]
) -> tuple[NDArray[np.intp], FloatArray]:
    """Nodes (N, 4) around measured pixels (N, 2), counted row by row, and their shares (N, 4)."""
    last = np.array([shape[1] - 1, shape[0] - 1])
    return nodes_around(points * (last / (np.array(image_size) - 1.0)), shape)


def nodes_around(place: FloatArray, shape: Sequence[int]) -> tuple[NDArray[np.intp], FloatArray]:
    """Nodes (..., 4) of a grid (rows, columns) around places (..., 2) in its units, x first, and their shares (..., 4).

    Outside of the grid they are those of its border.
    """
    rows, columns = shape
    last = np.array([columns - 1, rows - 1])
    place = np.clip(place, 0.0, last)
    cell = np.minimum(place.astype(np.intp), last - 1)
    x, y = np.moveaxis(place - cell, -1, 0)
    node = cell[..., 1] * columns + cell[..., 0]
    nodes = np.stack([node, node + 1, node + columns, node + columns + 1], axis=-1)
    return nodes, np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=-1)


def grid_shape(image_size: tuple[int, int], cells: int) -> tuple[int, int]:
    """Rows and columns of nodes with ``cells`` cells along the longer side, nearly square."""
    spacing = max(image_size) / cells
    columns, rows = (max(3, round(side / spacing) + 1) for side in image_size)
    return rows, columns


def node_points(image_size: tuple[int, int], shape: Sequence[int]) -> FloatArray:
    """Measured pixels (m n, 2) of the nodes, row by row."""
    rows, columns = shape
    x, y = np.linspace(0, image_size[0] - 1, columns), np.linspace(0, image_size[1] - 1, rows)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
