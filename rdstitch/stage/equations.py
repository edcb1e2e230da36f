"""The linear system of one step of the adjustment of all tiles.

What is unknown is one vector: the places of the tiles, what each row and each column is off, the matrix A from the
nominal places to pixels of the camera, an error that all blocks of a pair share, and λ. Its equations are of three
kinds: what blocks show, places against the model of the stage, and what is known beforehand.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.stage.grid import TileGrid
from rdstitch.stage.refinement import BlockMatches
from rdstitch.system.late_imports import sparse, sparse_linalg

_MIN_STD = 0.05  # standard deviation of a block, pixels, below which resampling and the camera do not let it come
_SCALE_STD = 0.02  # of an entry of A, before anything is seen
_LENS_STD = 0.5  # of λ, before anything is seen


@dataclass(frozen=True, eq=False)
class LinkedPoints:
    """Matches of all pairs, block by block."""

    pair: IntArray  # (M,), int: pair of each block
    tiles: IntArray  # (P, 2), int: tiles of each pair
    points1: FloatArray  # points1, points2: (M, 2): measured pixels of the two tiles
    points2: FloatArray
    information: FloatArray  # (M, 2, 2)

    @classmethod
    def of(cls, pairs: IntArray, matches: Mapping[int, BlockMatches]) -> "LinkedPoints":
        """The matches of those of the pairs (Q, 2) that have any, by the number of the pair."""
        blocks = [BlockMatches.none(), *matches.values()]
        return cls(
            np.repeat(np.arange(-1, len(matches)), [len(match) for match in blocks]),
            pairs[list(matches)],
            np.concatenate([match.points1 for match in blocks]),
            np.concatenate([match.points2 for match in blocks]),
            np.concatenate([match.information for match in blocks]),
        )

    def of_pairs(self, wanted: BoolArray) -> "LinkedPoints":
        """The matches of some of the pairs (P,)."""
        kept = wanted[self.pair]
        number = np.cumsum(wanted) - 1
        parts = (values[kept] for values in (self.points1, self.points2, self.information))
        return LinkedPoints(number[self.pair[kept]], self.tiles[wanted], *parts)

    def medians(self, values: FloatArray) -> FloatArray:
        """Medians (P,) over the blocks of each pair: of a wrong one all are off, of a right one a few may be."""
        order = np.lexsort([values, self.pair])
        number = np.bincount(self.pair, minlength=len(self.tiles))
        middle = np.cumsum(number) - number + (number - 1) // 2
        return np.asarray(values[order][middle] if len(values) else np.zeros(0))


class Variances(NamedTuple):
    """Variances about the model of the stage, and of the error that all blocks of a pair share, pixels²."""

    tile: float
    row: float
    column: float
    pair: float


class StageEquations:
    """The equations for tiles on a grid and what their pairs show."""

    def __init__(self, grid: TileGrid, links: LinkedPoints, *, free_lens: bool) -> None:
        self.links, self.free_lens, self.count = links, free_lens, len(grid)
        self.rows, self.columns = grid.rows, grid.columns
        self.middle = grid.places.mean(axis=0)
        self.nominal = grid.places - self.middle
        self.first, self.second = links.tiles[links.pair].T
        self.center = (np.array(grid.size) - 1.0) / 2.0
        self.scale = math.hypot(*grid.size) / 2.0
        sizes = self.count, int(self.rows.max()) + 1, int(self.columns.max()) + 1, 2, len(links.tiles)
        ends = np.cumsum([0, *(2 * size for size in sizes), 1]).tolist()
        # Where the parts are in the vector of the unknowns; λ is the last entry, and not solved for when it is known.
        self.place_slice, self.row_slice, self.column_slice, self.matrix_slice, self.shared_slice, self.lens_slice = (
            slice(start, stop) for start, stop in pairwise(ends)
        )
        self.size = self.lens_slice.stop if free_lens else self.lens_slice.start
        # Inverse square roots of the blocks' covariances, which are not better than blocks can be.
        information = links.information
        covariance = np.linalg.inv(information + 1e-12 * np.eye(2)) if len(information) else information
        self.root = np.linalg.cholesky(np.linalg.inv(covariance + _MIN_STD**2 * np.eye(2))).transpose(0, 2, 1)
        by_places = self._picking(self.place_slice, self.first) - self._picking(self.place_slice, self.second)
        self._by_pairs, self._by_blocks = by_places, by_places - self._picking(self.shared_slice, links.pair)
        self._by_stage = (
            self._picking(self.place_slice, np.arange(self.count))
            - self._picking(self.row_slice, self.rows)
            - self._picking(self.column_slice, self.columns)
            - self._nominal_by_matrix()
        )

    def _picking(self, part: slice, index: IntArray) -> "sparse.csr_matrix":
        """Rows that pick vectors (K, 2) by their numbers out of a part of the unknowns."""
        columns = (part.start + 2 * index[:, None] + np.arange(2)).ravel()
        rows = np.arange(len(columns))
        return sparse.csr_matrix((np.ones(len(columns)), (rows, columns)), shape=(len(columns), self.lens_slice.stop))

    def _nominal_by_matrix(self) -> "sparse.csr_matrix":
        """The nominal places on the camera's axes, of which each coordinate is a row of A times the nominal place."""
        rows = np.repeat(np.arange(2 * self.count), 2)
        columns = self.matrix_slice.start + np.tile(np.arange(4), self.count)
        values = np.repeat(self.nominal, 2, axis=0).ravel()
        return sparse.csr_matrix((values, (rows, columns)), shape=(2 * self.count, self.lens_slice.stop))

    def start(self, distortion: float) -> FloatArray:
        """Nominal places and λ."""
        state = np.zeros(self.lens_slice.stop)
        state[self.place_slice] = self.nominal.ravel()
        state[self.matrix_slice] = np.eye(2).ravel()
        state[self.lens_slice] = distortion
        return state

    def errors(self, state: FloatArray, *, of_blocks: bool = False) -> tuple[FloatArray, FloatArray]:
        """Residuals (M, 2), or what of them is not common to all blocks of a pair, and their derivatives by λ."""
        one, by_one = self._undistorted(self.links.points1, state[-1])
        two, by_two = self._undistorted(self.links.points2, state[-1])
        moved = (self._by_blocks if of_blocks else self._by_pairs) @ state
        return one - two + moved.reshape(-1, 2), by_one - by_two

    def _undistorted(self, points: FloatArray, distortion: float) -> tuple[FloatArray, FloatArray]:
        """Points without the lens, and their derivative by λ."""
        away = (points - self.center) / self.scale
        r2 = (away**2).sum(axis=1, keepdims=True)
        divisor = 1.0 + distortion * r2
        return self.center + self.scale * away / divisor, -self.scale * away * r2 / divisor**2

    def squared(self, state: FloatArray, *, of_blocks: bool = False) -> FloatArray:
        """Squared whitened errors of the blocks (M,)."""
        white = np.einsum("nij,nj->ni", self.root, self.errors(state, of_blocks=of_blocks)[0])
        return np.asarray((white**2).sum(axis=1))

    def off_stage(self, states: FloatArray) -> FloatArray:
        """Differences of places from the model of the stage, (…, N, 2), of states (…, D)."""
        return np.asarray((self._by_stage @ states.T).T.reshape(*states.shape[:-1], -1, 2))

    def solve(
        self, state: FloatArray, weights: FloatArray, noise: float, variances: Variances, count: int
    ) -> tuple[FloatArray, FloatArray]:
        """The state after one step, and draws of its errors (count, D)."""
        matrix, right = self._system(state, weights, noise, variances)
        factors = sparse_linalg.splu((matrix.T @ matrix).tocsc())
        changed = state.copy()
        changed[: self.size] += factors.solve(matrix.T @ right)
        # Errors of the equations have unit variance, so those of their solution have its covariance.
        errors = np.random.default_rng(0).normal(size=(len(right), count))
        draws = np.zeros((count, len(state)))
        draws[:, : self.size] = factors.solve(np.ascontiguousarray(matrix.T @ errors)).T
        return changed, draws

    def _system(
        self, state: FloatArray, weights: FloatArray, noise: float, variances: Variances
    ) -> tuple["sparse.csr_matrix", FloatArray]:
        """Rows of the least-squares problem for the change of the state, and their right sides, of unit variance."""
        errors, by_lens = self.errors(state, of_blocks=True)
        whiten = _block_diagonal(self.root * np.sqrt(weights / noise)[:, None, None])
        place = np.arange(errors.size), np.full(errors.size, self.lens_slice.start)
        blocks = self._by_blocks + sparse.csr_matrix((by_lens.ravel(), place), shape=self._by_blocks.shape)
        tile_std, row_std, column_std, pair_std = np.sqrt(variances)
        known = (self.row_slice, row_std), (self.column_slice, column_std), (self.matrix_slice, _SCALE_STD)
        beforehand = [*known, (self.shared_slice, pair_std), (self.lens_slice, _LENS_STD)]
        stds = np.concatenate([np.full(part.stop - part.start, std) for part, std in beforehand])
        usual = np.zeros(self.lens_slice.stop)
        usual[self.matrix_slice] = np.eye(2).ravel()
        after = slice(self.place_slice.stop, self.size)
        stds = stds[: self.size - self.place_slice.stop]
        prior = sparse.diags(1.0 / stds) @ sparse.eye(
            len(stds), self.lens_slice.stop, self.place_slice.stop, format="csr"
        )
        rows = sparse.vstack([whiten @ blocks, self._by_stage / tile_std, prior], format="csr")
        right = [-(whiten @ errors.ravel()), -self.off_stage(state).ravel() / tile_std, (usual - state)[after] / stds]
        return rows[:, : self.size], np.concatenate(right)


def _block_diagonal(blocks: FloatArray) -> "sparse.csr_matrix":
    """The matrix with blocks (M, 2, 2) on its diagonal."""
    side = 2 * len(blocks)
    columns = np.repeat(np.arange(side).reshape(-1, 1, 2), 2, axis=1)
    return sparse.csr_matrix((blocks.ravel(), columns.ravel(), 2 * np.arange(side + 1)), shape=(side, side))
