"""A smooth displacement field over one image: a bicubic spline through displacements on a coarse grid."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray, read_only
from rdstitch.errors import ArgumentError

_DECIMALS = 3  # pixels; what a sidecar stores is what was used
_APRON = 8  # nodes by which a field goes on as at the border: a spline is level at its end
_BEYOND = 4  # nodes beyond the border up to which it is evaluated: interpolating across it would find a kink there
_EDGE_POINTS = 9  # at which a bent edge is measured
_PROBES = 4  # of the steepness, along a side of a cell
_INVERSIONS = 12  # steps of a fixed-point iteration; where the steepness is a half, each halves the error
_LEVELLINGS = 200  # times that nodes of steep cells near their neighbours


@dataclass(frozen=True, eq=False)
class DisplacementField:
    """Displacements of one image.

    What the alignment expects at the measured pixels ``q`` is at ``q + field(q)``.
    """

    image_size: tuple[int, int]  # width and height of the image, pixels
    values: FloatArray  # (m, n, 2): pixels, at nodes spread evenly from the first to the last pixel, m rows of n

    def __post_init__(self) -> None:
        shape = self.values.shape
        if len(shape) != 3 or shape[2] != 2 or min(shape[:2]) < 2:
            raise ArgumentError(f"a displacement field has shape (m, n, 2), m and n at least 2, not {shape}")
        if not np.isfinite(self.values).all():
            raise ArgumentError("displacements must be finite")

    @classmethod
    def of(cls, image_size: tuple[int, int], values: FloatArray) -> Self:
        """A field with values rounded as a sidecar stores them."""
        return cls(image_size, np.round(values, _DECIMALS) + 0.0)

    def __call__(self, points: FloatArray) -> FloatArray:
        """Displacement (..., 2) at measured pixels (..., 2), also beside the image; far out as there, 0 at NaN."""
        last = np.array([self.values.shape[1] - 1, self.values.shape[0] - 1])
        place = np.nan_to_num(np.asarray(points, dtype=np.float64) * (last / _extent(self.image_size)))
        place = np.clip(place, -_BEYOND, last + _BEYOND) + _APRON
        cell = place.astype(np.intp)
        across, down = np.moveaxis(_cubic_weights(place - cell), -2, 0)
        weights = (down[..., :, None] * across[..., None, :]).reshape(*cell.shape[:-1], 16)
        # What matters in each cell, side by side: many times faster to gather.
        patches = np.lib.stride_tricks.sliding_window_view(self._coefficients, (4, 4), axis=(0, 1))
        patches = patches.reshape(*patches.shape[:3], 16)
        moved = np.einsum("...ck,...k->...c", patches[cell[..., 1] - 1, cell[..., 0] - 1], weights)
        return np.where(np.isnan(points).any(axis=-1, keepdims=True), 0.0, moved)

    def expected(self, points: FloatArray) -> FloatArray:
        """Where the alignment expects what is at measured pixels (..., 2), for a field that folds nothing."""
        expected = points
        for _ in range(_INVERSIONS):
            expected = points - self(expected)
        return expected

    def resized(self, image_size: tuple[int, int]) -> "DisplacementField":
        """The field for a resized copy of the image."""
        ratio = np.array(image_size, dtype=np.float64) / self.image_size
        return DisplacementField(image_size, self.values * ratio)

    @cached_property
    def largest(self) -> float:
        """Length of the largest displacement of a node, pixels."""
        return float(np.linalg.norm(self.values, axis=-1).max())

    @property
    def steepest(self) -> float:
        """Largest change of the displacement per pixel in any direction; below 1 the image does not fold."""
        return float(self._steepness.max())

    def levelled(self, steepest: float) -> "DisplacementField":
        """Limit changes to ``steepest`` per pixel: nodes of steeper cells move towards their neighbours.

        Only a field that is too steep nearly everywhere becomes smaller everywhere.
        """
        field = self
        for _ in range(_LEVELLINGS):
            steep = np.pad(field._steepness > steepest, 1)
            if not steep.any():
                return field
            chosen = (steep[:-1, :-1] | steep[:-1, 1:] | steep[1:, :-1] | steep[1:, 1:])[..., None]
            near = np.pad(field.values, ((1, 1), (1, 1), (0, 0)), mode="edge")
            mean = (near[:-2, 1:-1] + near[2:, 1:-1] + near[1:-1, :-2] + near[1:-1, 2:]) / 4.0
            field = DisplacementField(self.image_size, np.where(chosen, (field.values + mean) / 2.0, field.values))
        return DisplacementField(self.image_size, field.values * min(1.0, steepest / field.steepest))

    @cached_property
    def _steepness(self) -> FloatArray:
        """Largest change of the displacement per pixel in any direction, of each cell (m - 1, n - 1)."""
        down, across = (_evaluation(n) for n in self.values.shape[:2])
        # Rows, then columns: (2, rows, columns).
        moved = down @ np.moveaxis(self.values, -1, 0) @ across.T
        spacing = _extent(self.image_size) / (moved.shape[2] - 1, moved.shape[1] - 1)
        (a, c), (b, d) = np.diff(moved, axis=2)[:, :-1] / spacing[0], np.diff(moved, axis=1)[:, :, :-1] / spacing[1]
        # The larger singular value of each matrix of two rows and columns.
        steepness = (np.hypot(a + d, c - b) + np.hypot(a - d, c + b)) / 2.0
        rows, columns = self.values.shape[0] - 1, self.values.shape[1] - 1
        return np.asarray(steepness.reshape(rows, _PROBES, columns, _PROBES).max(axis=(1, 3)))

    def bends(self, edges: FloatArray) -> FloatArray:
        """How far straight edges with such ends (K, 2, 2) are bent, measured pixels (K,)."""
        fraction = np.linspace(0.0, 1.0, _EDGE_POINTS)[:, None, None]
        moved = self(edges[:, 0] + fraction * (edges[:, 1] - edges[:, 0]))
        along = edges[:, 1] - edges[:, 0]
        normal = np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.linalg.norm(along, axis=1, keepdims=True)
        off = moved - (moved[0] + fraction * (moved[-1] - moved[0]))
        return np.asarray(np.abs((off * normal).sum(axis=-1)).max(axis=0))

    @cached_property
    def _coefficients(self) -> FloatArray:
        """Coefficients of the B-spline, with the apron around, (rows, columns, 2)."""
        down, across = (_prefilter(n) for n in self.values.shape[:2])
        return np.moveaxis(down @ np.moveaxis(self.values, -1, 0) @ across.T, 0, -1)


def _extent(image_size: tuple[int, int]) -> FloatArray:
    """Distance from the first to the last pixel, (2,); 1 where there is one pixel only."""
    return np.maximum(np.array(image_size) - 1.0, 1.0)


def _cubic_weights(at: FloatArray) -> FloatArray:
    """What the four nodes around a place count in a cubic B-spline, (..., 4), by its share of a cell (...)."""
    left, square = 1.0 - at, at * at
    rest = left * left
    weights = [rest * left, 4.0 + square * (3.0 * at - 6.0), 4.0 + rest * (3.0 * left - 6.0), square * at]
    return np.stack(weights, axis=-1) * (1.0 / 6.0)


@lru_cache(maxsize=64)
def _prefilter(count: int) -> FloatArray:
    """Matrix (count + 2 aprons, count) from values at nodes in a row to the coefficients of their cubic B-spline."""
    around = ((_APRON, _APRON), (0, 0))
    padded = np.pad(np.eye(count), around, mode="reflect", reflect_type="odd")
    one, next_to = np.eye(len(padded)), np.eye(len(padded), k=1)
    values = (4.0 * one + next_to + next_to.T) / 6.0
    values[0, 1] = values[-1, -2] = 2.0 / 6.0
    return read_only(np.asarray(np.linalg.solve(values, padded), dtype=np.float64))


@lru_cache(maxsize=64)
def _evaluation(count: int) -> FloatArray:
    """Matrix from values at nodes in a row to those of their spline at evenly spread places, some between two nodes."""
    place = np.linspace(0.0, count - 1.0, _PROBES * (count - 1) + 1) + _APRON
    cell = np.minimum(place.astype(np.intp), count + _APRON - 2)
    basis = np.zeros((len(place), count + 2 * _APRON))
    columns = cell[:, None] + np.arange(-1, 3)
    np.put_along_axis(basis, columns, _cubic_weights(place - cell), axis=1)
    return read_only(basis @ _prefilter(count))


def bilinear(
    points: FloatArray, image_size: tuple[int, int], shape: Sequence[int]
) -> tuple[NDArray[np.intp], FloatArray]:
    """Nodes (N, 4) around measured pixels (N, 2), counted row by row, and their shares (N, 4)."""
    last = np.array([shape[1] - 1, shape[0] - 1])
    return nodes_around(points * (last / _extent(image_size)), shape)


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
