"""All places at once: links by what they show, and the stage as a prior whose variances the grid itself tells.

A tile lies at ``t = A n + row + column + ε``: n is where the stage was told to go, A the camera's turn and scale
against the stage's axes, row and column what each line is off as a whole (backlash), ε the rest. The variances of
these three are estimated with the places (expectation maximization), so that a tile without links has the place that
the model of the stage gives it.
"""

import math
from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.stage.grid import TileGrid
from rdstitch.system.late_imports import sparse, sparse_linalg

_ROUNDS = 12
_GENEROUS = 20.0  # widths of the robust loss in the first round; it is halved until it is 1
_WIDTH = 4.0  # standard deviations at which a link counts a quarter: Geman and McClure's loss
_MEDIAN = 1.386  # median of the sum of two squared standard normal numbers
_LEAST_STD = 0.05  # standard deviation of a block, pixels, below which resampling and the camera do not let it come
_USUAL_COUNT = 1.0  # tiles or lines that what the stage may be off before anything is known counts for
_SCALE_STD = 0.02
_LENS_STD = 0.5


@dataclass(frozen=True)
class LinkedPoints:
    """Matches of all pairs, block by block."""

    pair: IntArray  # (M,), int: pair of each block
    tiles: IntArray  # (P, 2), int: tiles of each pair
    points1: FloatArray  # points1, points2: (M, 2): measured pixels of the two tiles
    points2: FloatArray
    information: FloatArray  # (M, 2, 2)


@dataclass(frozen=True)
class StageModel:
    """Errors of the stage."""

    matrix: FloatArray  # (2, 2): from pixels of the nominal places to pixels of the camera
    rows: FloatArray  # rows, columns: (R, 2) and (C, 2): what each line is off as a whole, pixels
    columns: FloatArray
    row_std: float  # row_std, column_std, std: standard deviations of those and of what is left of each tile
    column_std: float
    std: float


@dataclass(frozen=True)
class Adjustment:
    """All places."""

    places: FloatArray  # (N, 2): of the undistorted tiles, pixels
    # distortion, distortion_std: λ in the half-diagonal frame, and its standard deviation; inf where nothing shows it,
    # 0 where it was given
    distortion: float
    distortion_std: float
    weights: FloatArray  # (P,): of each pair, 0 for one that contradicts the others, 1 for one that agrees
    residuals: FloatArray  # (M, 2): undistorted pixels
    squared: FloatArray  # (M,): squared errors of the blocks, in variances by their information
    noise: float  # how much larger they are in the median than by that
    stage: StageModel

    def cost(self, noise: float) -> float:
        """Robust sum of the squared errors of the blocks for so much noise."""
        whitened = self.squared / noise
        return float((whitened * _WIDTH**2 / (whitened + _WIDTH**2)).sum())


def adjust(
    grid: TileGrid, links: LinkedPoints, stage_std: float, distortion: float = 0.0, *, free_lens: bool = False
) -> Adjustment:
    """Adjust all places; to begin with a tile may be ``stage_std`` pixels off."""
    problem = _Problem(grid, links, free_lens)
    state = problem.start(distortion)
    variances = np.array([stage_std**2] * 3)
    weights, pair_weights = np.ones(len(links.pair)), np.ones(len(links.tiles))
    width, noise = _GENEROUS, 1.0
    for _ in range(_ROUNDS):
        state = problem.solve(state, weights, noise, variances)
        variances = problem.variances(state, weights, stage_std**2)
        squared = problem.squared(state)
        agreeing = squared[weights > 0.1]
        noise = max(float(np.median(agreeing)) / _MEDIAN if len(agreeing) else 1.0, 1e-3)
        width = max(width / 2.0, 1.0)
        scale = noise * (width * _WIDTH) ** 2
        pair_weights = 1.0 / (1.0 + problem.medians_of_pairs(squared) / scale) ** 2
        weights = pair_weights[links.pair] / (1.0 + squared / scale) ** 2
    return problem.result(state, weights, pair_weights, noise, variances, given=not free_lens and distortion != 0.0)


class _Problem:
    """The linear system of one step, and what is read off its solution."""

    def __init__(self, grid: TileGrid, links: LinkedPoints, free_lens: bool) -> None:
        self.grid, self.links, self.free_lens = grid, links, free_lens
        self.rows, self.columns = grid.rows, grid.columns
        self.middle = grid.places.mean(axis=0)
        self.nominal = grid.places - self.middle
        count = len(grid)
        lines = int(self.rows.max()) + 1, int(self.columns.max()) + 1
        starts = np.cumsum([0, 2 * count, 2 * lines[0], 2 * lines[1], 4, int(free_lens)])
        self.at_rows, self.at_columns, self.at_matrix, self.at_lens, self.size = starts[1:].tolist()
        self.lines = lines
        information = links.information
        # Not better than blocks can be.
        covariance = np.linalg.inv(information + 1e-12 * np.eye(2)) if len(information) else information
        self.root = np.linalg.cholesky(np.linalg.inv(covariance + _LEAST_STD**2 * np.eye(2))).transpose(0, 2, 1)
        self.first, self.second = links.tiles[links.pair].T
        self.center = (np.array(grid.size) - 1.0) / 2.0
        self.scale = math.hypot(*grid.size) / 2.0
        self.linked = np.zeros(count, dtype=np.bool_)
        self.linked[links.tiles.ravel()] = True

    def start(self, distortion: float) -> FloatArray:
        """Nominal places and λ."""
        state = np.zeros(self.at_lens + 1)
        state[: 2 * len(self.grid)] = self.nominal.ravel()
        state[self.at_matrix : self.at_lens] = np.eye(2).ravel()
        state[self.at_lens] = distortion
        return state

    def undistorted(self, points: FloatArray, distortion: float) -> tuple[FloatArray, FloatArray]:
        """Points without the lens, and their derivative by λ."""
        away = (points - self.center) / self.scale
        r2 = (away**2).sum(axis=1, keepdims=True)
        divisor = 1.0 + distortion * r2
        return self.center + self.scale * away / divisor, -self.scale * away * r2 / divisor**2

    def errors(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals of the blocks (M, 2) and their derivatives by λ."""
        places = state[: 2 * len(self.grid)].reshape(-1, 2)
        one, by_one = self.undistorted(self.links.points1, state[-1])
        two, by_two = self.undistorted(self.links.points2, state[-1])
        return one + places[self.first] - two - places[self.second], by_one - by_two

    def squared(self, state: FloatArray) -> FloatArray:
        """Squared whitened errors of the blocks."""
        white = np.einsum("nij,nj->ni", self.root, self.errors(state)[0])
        return np.asarray((white**2).sum(axis=1))

    def medians_of_pairs(self, values: FloatArray) -> FloatArray:
        """Medians over the blocks of each pair: of a wrong one all are off, of a right one a few may be."""
        order = np.lexsort([values, self.links.pair])
        number = np.bincount(self.links.pair, minlength=len(self.links.tiles))
        middle = np.cumsum(number) - number + (number - 1) // 2
        return np.asarray(values[order][middle] if len(values) else np.zeros(0))

    def _equations(
        self, state: FloatArray, weights: FloatArray, noise: float, variances: FloatArray
    ) -> tuple["sparse.csr_matrix", FloatArray]:
        """Rows of the least-squares problem for the change of the state."""
        errors, by_lens = self.errors(state)
        root = self.root * np.sqrt(weights / noise)[:, None, None]
        blocks = []
        count, places = len(errors), 2 * len(self.grid)
        number = np.repeat(np.arange(2 * count).reshape(-1, 2, 1), 2, axis=2)
        for tile, sign in ((self.first, 1.0), (self.second, -1.0)):
            column = np.repeat((2 * tile[:, None] + np.arange(2))[:, None], 2, axis=1)
            blocks.append((sign * root, number, column))
        if self.free_lens:
            slope = np.einsum("nij,nj->ni", root, by_lens)
            blocks.append((slope, number[:, :, 0], np.full_like(number[:, :, 0], self.at_lens)))
        right = [-np.einsum("nij,nj->ni", root, errors).ravel()]
        base = 2 * count
        tile_std, row_std, column_std = np.sqrt(variances)
        # Places against the model of the stage.
        axis = np.arange(2)
        coordinate = np.arange(places)
        rows = base + coordinate
        blocks.append((np.full(places, 1.0 / tile_std), rows, coordinate))
        for start, line in ((self.at_rows, self.rows), (self.at_columns, self.columns)):
            blocks.append((np.full(places, -1.0 / tile_std), rows, (start + 2 * line[:, None] + axis).ravel()))
        for k in range(2):
            values = -np.repeat(self.nominal[:, k], 2) / tile_std
            blocks.append((values, rows, np.tile(self.at_matrix + 2 * axis + k, len(self.grid))))
        right.append(-self._off_stage(state).ravel() / tile_std)
        base += places
        for start, stop, std in (
            (self.at_rows, self.at_columns, row_std),
            (self.at_columns, self.at_matrix, column_std),
            (self.at_matrix, self.at_lens, _SCALE_STD),
            (self.at_lens, self.size, _LENS_STD),
        ):
            length = stop - start
            usual = np.eye(2).ravel() if start == self.at_matrix else np.zeros(length)
            blocks.append((np.full(length, 1.0 / std), base + np.arange(length), np.arange(start, stop)))
            right.append((usual - state[start:stop]) / std)
            base += length
        data, row, column = (np.concatenate([np.ravel(block[k]) for block in blocks]) for k in range(3))
        return sparse.csr_matrix((data, (row, column)), shape=(base, self.size)), np.concatenate(right)

    def _off_stage(self, state: FloatArray) -> FloatArray:
        """Compute the differences of places from the model of the stage, (N, 2)."""
        places = state[: 2 * len(self.grid)].reshape(-1, 2)
        matrix = state[self.at_matrix : self.at_lens].reshape(2, 2)
        rows, columns = self._lines(state)
        return np.asarray(places - self.nominal @ matrix.T - rows[self.rows] - columns[self.columns])

    def _lines(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows = state[self.at_rows : self.at_columns].reshape(-1, 2)
        return rows, state[self.at_columns : self.at_matrix].reshape(-1, 2)

    def solve(self, state: FloatArray, weights: FloatArray, noise: float, variances: FloatArray) -> FloatArray:
        """The state after one step."""
        matrix, right = self._equations(state, weights, noise, variances)
        step = sparse_linalg.spsolve((matrix.T @ matrix).tocsc(), matrix.T @ right)
        changed = state.copy()
        changed[: self.size] += step
        return changed

    def variances(self, state: FloatArray, weights: FloatArray, usual: float) -> FloatArray:
        """Variances of tiles, rows and columns about the model of the stage, from those that links hold.

        A few times the usual variance is among them, lest a variance vanish by which its own estimates are small.
        """
        held = np.zeros(len(self.grid), dtype=np.bool_)
        held[self.first[weights > 0.25]] = held[self.second[weights > 0.25]] = True
        deviations = [self._off_stage(state)[held]]
        for lines, number in zip(self._lines(state), (self.rows, self.columns), strict=True):
            deviations.append(lines[np.unique(number[held])])
        return np.array([(0.5 * (v**2).sum() + _USUAL_COUNT * usual) / (len(v) + _USUAL_COUNT) for v in deviations])

    def result(
        self,
        state: FloatArray,
        weights: FloatArray,
        pair_weights: FloatArray,
        noise: float,
        variances: FloatArray,
        *,
        given: bool,
    ) -> Adjustment:
        """Build the result, with the standard deviation of λ."""
        deviation = 0.0 if given else math.inf
        if self.free_lens:
            matrix, _ = self._equations(state, weights, noise, variances)
            unit = np.zeros(self.size)
            unit[self.at_lens] = 1.0
            variance = sparse_linalg.spsolve((matrix.T @ matrix).tocsc(), unit)[self.at_lens]
            deviation = math.sqrt(max(float(variance), 0.0))
        rows, columns = self._lines(state)
        tile_std, row_std, column_std = np.sqrt(variances).tolist()
        model = StageModel(
            state[self.at_matrix : self.at_lens].reshape(2, 2), rows, columns, row_std, column_std, tile_std
        )
        return Adjustment(
            state[: 2 * len(self.grid)].reshape(-1, 2) + self.middle,
            float(state[-1]),
            deviation,
            pair_weights,
            self.errors(state)[0],
            self.squared(state),
            noise,
            model,
        )
