"""The linear system of one step of the adjustment of all tiles.

What is unknown is one vector: the places of the tiles, what each row and each column is off, the matrix A from the
nominal places to pixels of the camera, an error that all blocks of a pair share, and λ. Its equations are of three
kinds: what blocks show, places against the model of the stage, and what is known beforehand.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
    blocks: BlockMatches  # of all pairs, M

    @classmethod
    def of(cls, pairs: IntArray, matches: Mapping[int, BlockMatches]) -> "LinkedPoints":
        """The matches of those of the pairs (Q, 2) that have any, by the number of the pair."""
        blocks = [BlockMatches.none(), *matches.values()]
        return cls(
            np.repeat(np.arange(-1, len(matches)), [len(match) for match in blocks]),
            pairs[list(matches)],
            BlockMatches.concatenate(blocks),
        )

    def of_pairs(self, wanted: BoolArray) -> "LinkedPoints":
        """The matches of some of the pairs (P,)."""
        kept = wanted[self.pair]
        return LinkedPoints((np.cumsum(wanted) - 1)[self.pair[kept]], self.tiles[wanted], self.blocks.take(kept))

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


class StageState(NamedTuple):
    """What is unknown, or errors of it: parts of one vector, or of several where they have one axis more in front."""

    vector: NDArray[Any]  # (D,): all parts that follow, one behind the other
    places: NDArray[Any]  # (N, 2): of the tiles, pixels from the middle of the grid
    rows: NDArray[Any]  # rows, columns: (R, 2) and (C, 2): what each line is off as a whole, pixels
    columns: NDArray[Any]
    matrix: NDArray[Any]  # (2, 2): A
    shared: NDArray[Any]  # (P, 2): errors that all blocks of a pair share, pixels
    lens: NDArray[Any]  # (1,): λ, which is not solved for when it is known

    @classmethod
    def of(cls, vector: NDArray[Any], sizes: Sequence[int]) -> "StageState":
        """The parts of vectors (…, D): of so many pairs of numbers each, and λ."""
        *parts, lens = np.split(vector, 2 * np.cumsum(sizes), axis=-1)
        places, rows, columns, matrix, shared = (part.reshape(*part.shape[:-1], -1, 2) for part in parts)
        return cls(vector, places, rows, columns, matrix, shared, lens)


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
        self._sizes = self.count, int(self.rows.max()) + 1, int(self.columns.max()) + 1, 2, len(links.tiles)
        size = 2 * sum(self._sizes) + 1
        self._entry = StageState.of(np.arange(size), self._sizes)  # of each unknown, its number in the vector
        self._solved = size if free_lens else size - 1
        # Inverse square roots of the blocks' covariances, which are not better than blocks can be.
        information = links.blocks.information
        covariance = np.linalg.inv(information + 1e-12 * np.eye(2)) if len(information) else information
        self.root = np.linalg.cholesky(np.linalg.inv(covariance + _MIN_STD**2 * np.eye(2))).transpose(0, 2, 1)
        entry = self._entry
        by_places = self._picking(entry.places[self.first]) - self._picking(entry.places[self.second])
        self._by_pairs, self._by_blocks = by_places, by_places - self._picking(entry.shared[links.pair])
        self._by_stage = (
            self._picking(entry.places)
            - self._picking(entry.rows[self.rows])
            - self._picking(entry.columns[self.columns])
            - self._nominal_by_matrix()
        )

    def _picking(self, entries: NDArray[Any]) -> "sparse.csr_matrix":
        """Rows that pick vectors (K, 2) out of the unknowns by the numbers of their entries."""
        ones, rows = np.ones(entries.size), np.arange(entries.size)
        return sparse.csr_matrix((ones, (rows, entries.ravel())), shape=(entries.size, len(self._entry.vector)))

    def _nominal_by_matrix(self) -> "sparse.csr_matrix":
        """The nominal places on the camera's axes, of which each coordinate is a row of A times the nominal place."""
        rows = np.repeat(np.arange(2 * self.count), 2)
        columns = np.tile(self._entry.matrix.ravel(), self.count)
        values = np.repeat(self.nominal, 2, axis=0).ravel()
        return sparse.csr_matrix((values, (rows, columns)), shape=(2 * self.count, len(self._entry.vector)))

    def start(self, distortion: float) -> StageState:
        """Nominal places and λ."""
        vector = np.zeros(len(self._entry.vector))
        vector[self._entry.places] = self.nominal
        vector[self._entry.matrix] = np.eye(2)
        vector[self._entry.lens] = distortion
        return StageState.of(vector, self._sizes)

    def errors(self, state: StageState, *, of_blocks: bool = False) -> tuple[FloatArray, FloatArray]:
        """Residuals (M, 2), or what of them is not common to all blocks of a pair, and their derivatives by λ."""
        one, by_one = self._undistorted(self.links.blocks.points1, state.lens)
        two, by_two = self._undistorted(self.links.blocks.points2, state.lens)
        moved = (self._by_blocks if of_blocks else self._by_pairs) @ state.vector
        return one - two + moved.reshape(-1, 2), by_one - by_two

    def _undistorted(self, points: FloatArray, distortion: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points without the lens, and their derivative by λ."""
        away = (points - self.center) / self.scale
        r2 = (away**2).sum(axis=1, keepdims=True)
        divisor = 1.0 + distortion * r2
        return self.center + self.scale * away / divisor, -self.scale * away * r2 / divisor**2

    def squared(self, state: StageState, *, of_blocks: bool = False) -> FloatArray:
        """Squared whitened errors of the blocks (M,)."""
        white = np.einsum("nij,nj->ni", self.root, self.errors(state, of_blocks=of_blocks)[0])
        return np.asarray((white**2).sum(axis=1))

    def off_stage(self, state: StageState) -> FloatArray:
        """Differences of places from the model of the stage, (…, N, 2)."""
        return np.asarray((self._by_stage @ state.vector.T).T.reshape(state.places.shape))

    def solve(
        self, state: StageState, weights: FloatArray, noise: float, variances: Variances, count: int
    ) -> tuple[StageState, StageState]:
        """The state after one step, and so many draws of its errors."""
        matrix, right = self._system(state, weights, noise, variances)
        factors = sparse_linalg.splu((matrix.T @ matrix).tocsc())
        changed = state.vector.copy()
        changed[: self._solved] += factors.solve(matrix.T @ right)
        # Errors of the equations have unit variance, so those of their solution have its covariance.
        errors = np.random.default_rng(0).normal(size=(len(right), count))
        draws = np.zeros((count, len(changed)))
        draws[:, : self._solved] = factors.solve(np.ascontiguousarray(matrix.T @ errors)).T
        return StageState.of(changed, self._sizes), StageState.of(draws, self._sizes)

    def _system(
        self, state: StageState, weights: FloatArray, noise: float, variances: Variances
    ) -> tuple["sparse.csr_matrix", FloatArray]:
        """Rows of the least-squares problem for the change of the state, and their right sides, of unit variance."""
        errors, by_lens = self.errors(state, of_blocks=True)
        roots = self.root * np.sqrt(weights / noise)[:, None, None]
        whiten = sparse.bsr_matrix((roots, np.arange(len(roots)), np.arange(len(roots) + 1)), shape=(errors.size,) * 2)
        place = np.arange(errors.size), np.full(errors.size, self._entry.lens)
        blocks = self._by_blocks + sparse.csr_matrix((by_lens.ravel(), place), shape=self._by_blocks.shape)
        tile_std, row_std, column_std, pair_std = np.sqrt(variances)
        # Beforehand everything but the places is as at the start, within these standard deviations.
        known = slice(2 * self.count, self._solved)
        by_part = zip(self._entry[2:], (row_std, column_std, _SCALE_STD, pair_std, _LENS_STD), strict=True)
        stds = np.concatenate([np.full(part.size, std) for part, std in by_part])[: self._solved - known.start]
        prior = sparse.diags(1.0 / stds) @ sparse.eye(len(stds), len(state.vector), known.start, format="csr")
        change = (self.start(0.0).vector - state.vector)[known]
        rows = sparse.vstack([whiten @ blocks, self._by_stage / tile_std, prior], format="csr")
        right = [-(whiten @ errors.ravel()), -self.off_stage(state).ravel() / tile_std, change / stds]
        return rows[:, : self._solved], np.concatenate(right)
