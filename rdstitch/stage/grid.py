"""Nominal places of the tiles, their rows and columns."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.errors import ArgumentError
from rdstitch.system.late_imports import spatial

_SAME_LINE = 0.25  # share of a tile within which places belong to one row or column
_NEAREST = 5  # places: a tile and one on each side of it
_MAX_TURN = math.radians(22.5)  # of the stage to the camera; diagonal neighbours are farther from both axes
# share of a tile's shorter side along which an overlap is worth comparing: corners of diagonal neighbours are not
_MIN_OVERLAP = 0.3


@dataclass(frozen=True, eq=False)
class TileGrid:
    """Nominal places of tiles."""

    places: FloatArray  # (N, 2): of the first pixel of each tile, pixels; x to the right, y down
    size: tuple[int, int]  # width and height of the largest tile, pixels
    pixel_size: float | None = None  # micrometres, where it is known
    source: str = ""  # where the places come from, for reports
    tile_sizes: IntArray | None = None  # (N, 2): width and height of each tile, where they differ

    def __post_init__(self) -> None:
        if self.places.ndim != 2 or self.places.shape[1] != 2 or not np.isfinite(self.places).all():
            raise ArgumentError("places of tiles are finite numbers x, y, one pair a tile")

    def __len__(self) -> int:
        """Number of tiles."""
        return len(self.places)

    @property
    def sizes(self) -> IntArray:
        """Width and height of each tile, (N, 2)."""
        return (
            np.tile(np.array(self.size, dtype=np.intp), (len(self), 1)) if self.tile_sizes is None else self.tile_sizes
        )

    @property
    def rows(self) -> IntArray:
        """Row of each tile, from 0 at the top."""
        return _lines(self._upright_places[:, 1], _SAME_LINE * self.size[1])

    @property
    def columns(self) -> IntArray:
        """Column of each tile, from 0 at the left."""
        return _lines(self._upright_places[:, 0], _SAME_LINE * self.size[0])

    @cached_property
    def _upright_places(self) -> FloatArray:
        """The places (N, 2), turned so that most neighbours lie along the axes."""
        nearest = spatial.cKDTree(self.places).query(self.places, k=min(_NEAREST, len(self)))[1].reshape(len(self), -1)
        places = self.places @ np.array([1.0, 1.0j])
        off = places[nearest] - places[:, None]
        off = off[off != 0.0]
        # The angle to the nearer axis; diagonal neighbours are at neither.
        angles = np.angle(off * 1j ** -np.rint(np.angle(off) / (np.pi / 2.0)))
        angles = angles[np.abs(angles) < _MAX_TURN]
        turn = np.exp(-1j * np.median(angles)) if len(angles) else 1.0
        upright = places * turn
        return np.stack([upright.real, upright.imag], axis=-1)

    def neighbours(self, reach: float) -> NDArray[np.intp]:
        """Pairs (M, 2) of tiles that may overlap along a good part of a side, ordered so that few are held at once."""
        sizes = self.sizes.astype(np.float64)
        order = np.argsort(self.places[:, 1], kind="stable")
        y = self.places[order, 1]
        pairs = []
        for position, first in enumerate(order.tolist()):
            stop = int(np.searchsorted(y, y[position] + sizes[first, 1] + reach))
            candidates = order[position + 1 : stop]
            low = np.maximum(self.places[candidates], self.places[first])
            high = np.minimum(self.places[candidates] + sizes[candidates], self.places[first] + sizes[first])
            common, least = high - low, np.minimum(sizes[candidates], sizes[first]).min(axis=1)
            near = (common > -reach / 2).all(axis=1) & (common.max(axis=1) > _MIN_OVERLAP * least)
            pairs += [(min(first, k), max(first, k)) for k in candidates[near].tolist()]
        rank = np.empty(len(self), dtype=np.intp)
        rank[np.lexsort([self.places[:, 0], self.columns, self.rows])] = np.arange(len(self))
        return np.array(sorted(pairs, key=lambda pair: sorted(rank[[*pair]])), dtype=np.intp).reshape(-1, 2)


def _lines(values: FloatArray, tolerance: float) -> IntArray:
    """Numbers of the groups that values along an axis form, from the smallest on."""
    order = np.argsort(values, kind="stable")
    steps = np.diff(values[order], prepend=values[order[0]]) > tolerance
    lines = np.empty(len(values), dtype=np.intp)
    lines[order] = np.cumsum(steps)
    return lines
