"""All places at once: links by what they show, and the stage as a prior whose variances the grid itself tells.

A tile lies at ``t = A n + row + column + ε``: n is where the stage was told to go, A the camera's turn and scale
against the stage's axes, row and column what each line is off as a whole (backlash), ε the rest. The variances of
these three are estimated with the places (expectation maximization), so that a tile without links has the place that
the model of the stage gives it.
"""

import math
from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.stage.grid import TileGrid
from rdstitch.system.late_imports import sparse, sparse_linalg

_ROUNDS = 12
_GENEROUS = 20.0  # widths of the robust loss in the first round; it is halved until it is 1
_WIDTH = 4.0  # standard deviations at which a link counts a quarter: Geman and McClure's loss
_MEDIAN = 1.386  # median of the sum of two squared standard normal numbers
_PAIR_STD = 0.03  # standard deviation of an error that all blocks of a pair share, pixels, before it is estimated
_LEAST_NOISE = 0.1  # of the variances that blocks are said to have
_LEAST_STD = 0.05  # standard deviation of a block, pixels, below which resampling and the camera do not let it come
_SAMPLES = 16, 64  # draws from the posterior: to estimate the variances of the stage, and in the result
_TAILS = 4.0  # degrees of freedom of the places about the stage's model: a few tiles may be far off
_LEAST_LINES = 4  # rows or columns whose errors show what rows or columns are off
_SCALE_STD = 0.02
_LENS_STD = 0.5


@dataclass(frozen=True, eq=False)
class LinkedPoints:
    """Matches of all pairs, block by block."""

    pair: IntArray  # (M,), int: pair of each block
    tiles: IntArray  # (P, 2), int: tiles of each pair
    points1: FloatArray  # points1, points2: (M, 2): measured pixels of the two tiles
    points2: FloatArray
    information: FloatArray  # (M, 2, 2)

    def of_pairs(self, wanted: BoolArray) -> "LinkedPoints":
        """The matches of some of the pairs (P,)."""
        kept = wanted[self.pair]
        number = np.cumsum(wanted) - 1
        parts = (values[kept] for values in (self.points1, self.points2, self.information))
        return LinkedPoints(number[self.pair[kept]], self.tiles[wanted], *parts)


@dataclass(frozen=True, eq=False)
class StageModel:
    """Errors of the stage."""

    matrix: FloatArray  # (2, 2): from pixels of the nominal places to pixels of the camera
    rows: FloatArray  # rows, columns: (R, 2) and (C, 2): what each line is off as a whole, pixels
    columns: FloatArray
    # row_std, column_std: standard deviations of those, where enough rows or columns show them; std: of what is left of
    # each tile
    row_std: float | None
    column_std: float | None
    std: float


@dataclass(frozen=True, eq=False)
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
    off_stage: FloatArray  # (N, 2): what each tile is off against the model of the stage
    deviations: FloatArray  # (S, N, 2): draws of the errors of the places, pixels

    def between(self, pair: IntArray) -> tuple[FloatArray, FloatArray]:
        """Place of the second tile of a pair in the first (2,), and its covariance (2, 2)."""
        first, second = pair.tolist()
        off = self.deviations[:, second] - self.deviations[:, first]
        return self.places[second] - self.places[first], np.asarray(off.T @ off / len(off))

    def stds(self, group: IntArray) -> FloatArray:
        """Standard deviation of each tile's place against a group of them, in x and y alike, pixels (N,)."""
        off = self.deviations - self.deviations[:, group].mean(axis=1, keepdims=True)
        return np.asarray(np.sqrt((off**2).mean(axis=(0, 2))))

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
    variances = np.array([stage_std**2] * 3 + [_PAIR_STD**2])
    weights, pair_weights = np.ones(len(links.pair)), np.ones(len(links.tiles))
    width, noise = _GENEROUS, 1.0
    for _ in range(_ROUNDS):
        state, draws = problem.solve(state, weights, noise, variances, _SAMPLES[0])
        variances = problem.variances(state, draws, weights, stage_std**2)
        squared = problem.squared(state)
        agreeing, of_blocks = weights > 0.1, problem.squared(state, of_blocks=True)
        noise, usual = (
            max(float(np.median(values[agreeing])) / _MEDIAN if agreeing.any() else 1.0, least)
            for values, least in ((of_blocks, _LEAST_NOISE), (squared, 1.0))
        )
        width = max(width / 2.0, 1.0)
        scale = usual * (width * _WIDTH) ** 2
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
        starts = np.cumsum([0, 2 * count, 2 * lines[0], 2 * lines[1], 4, 2 * len(links.tiles), int(free_lens)])
        self.at_rows, self.at_columns, self.at_matrix, self.at_pairs, self.at_lens, self.size = starts[1:].tolist()
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
        state[self.at_matrix : self.at_pairs] = np.eye(2).ravel()
        state[self.at_lens] = distortion
        return state

    def undistorted(self, points: FloatArray, distortion: float) -> tuple[FloatArray, FloatArray]:
        """Points without the lens, and their derivative by λ."""
        away = (points - self.center) / self.scale
        r2 = (away**2).sum(axis=1, keepdims=True)
        divisor = 1.0 + distortion * r2
        return self.center + self.scale * away / divisor, -self.scale * away * r2 / divisor**2

    def errors(self, state: FloatArray, *, of_blocks: bool = False) -> tuple[FloatArray, FloatArray]:
        """Residuals (M, 2), or what of them is not common to all blocks of a pair, and their derivatives by λ."""
        places = state[: 2 * len(self.grid)].reshape(-1, 2)
        one, by_one = self.undistorted(self.links.points1, state[-1])
        two, by_two = self.undistorted(self.links.points2, state[-1])
        common = state[self.at_pairs : self.at_lens].reshape(-1, 2)[self.links.pair] if of_blocks else 0.0
        return one + places[self.first] - two - places[self.second] - common, by_one - by_two

    def squared(self, state: FloatArray, *, of_blocks: bool = False) -> FloatArray:
        """Squared whitened errors of the blocks."""
        white = np.einsum("nij,nj->ni", self.root, self.errors(state, of_blocks=of_blocks)[0])
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
        errors, by_lens = self.errors(state, of_blocks=True)
        root = self.root * np.sqrt(weights / noise)[:, None, None]
        blocks = []
        count, places = len(errors), 2 * len(self.grid)
        number = np.repeat(np.arange(2 * count).reshape(-1, 2, 1), 2, axis=2)
        for tile, sign in ((self.first, 1.0), (self.second, -1.0)):
            column = np.repeat((2 * tile[:, None] + np.arange(2))[:, None], 2, axis=1)
            blocks.append((sign * root, number, column))
        common = np.repeat((self.at_pairs + 2 * self.links.pair[:, None] + np.arange(2))[:, None], 2, axis=1)
        blocks.append((-root, number, common))
        if self.free_lens:
            slope = np.einsum("nij,nj->ni", root, by_lens)
            blocks.append((slope, number[:, :, 0], np.full_like(number[:, :, 0], self.at_lens)))
        right = [-np.einsum("nij,nj->ni", root, errors).ravel()]
        base = 2 * count
        tile_std, row_std, column_std, pair_std = np.sqrt(variances)
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
            (self.at_matrix, self.at_pairs, _SCALE_STD),
            (self.at_pairs, self.at_lens, pair_std),
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
        """Compute the differences of places from the model of the stage, (…, N, 2), of states (…, D)."""
        places = state[..., : 2 * len(self.grid)].reshape(*state.shape[:-1], -1, 2)
        matrix = state[..., self.at_matrix : self.at_pairs].reshape(*state.shape[:-1], 2, 2)
        rows, columns = self._lines(state)
        on_axes = self.nominal @ np.swapaxes(matrix, -1, -2)
        return np.asarray(places - on_axes - rows[..., self.rows, :] - columns[..., self.columns, :])

    def _lines(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows = state[..., self.at_rows : self.at_columns].reshape(*state.shape[:-1], -1, 2)
        return rows, state[..., self.at_columns : self.at_matrix].reshape(*state.shape[:-1], -1, 2)

    def solve(
        self, state: FloatArray, weights: FloatArray, noise: float, variances: FloatArray, count: int
    ) -> tuple[FloatArray, FloatArray]:
        """The state after one step, and draws of its errors (count, D)."""
        matrix, right = self._equations(state, weights, noise, variances)
        factors = sparse_linalg.splu((matrix.T @ matrix).tocsc())
        changed = state.copy()
        changed[: self.size] += factors.solve(matrix.T @ right)
        # Errors of the equations have unit variance, so those of their solution have its covariance.
        errors = np.random.default_rng(0).normal(size=(len(right), count))
        draws = np.zeros((count, len(state)))
        draws[:, : self.size] = factors.solve(np.ascontiguousarray(matrix.T @ errors)).T
        return changed, draws

    def variances(self, state: FloatArray, draws: FloatArray, weights: FloatArray, usual: float) -> FloatArray:
        """Variances of tiles, rows and columns about the model of the stage, from those that links hold.

        The fewer they are, the more counts what is usual.
        """
        held = np.zeros(len(self.grid), dtype=np.bool_)
        held[self.first[weights > 0.25]] = held[self.second[weights > 0.25]] = True
        off, spread = self._off_stage(state)[held], self._off_stage(draws)[:, held]
        squared = [(off**2).sum(axis=1) + (spread**2).mean(axis=0).sum(axis=1)]
        for lines, spreads, number in zip(
            self._lines(state), self._lines(draws), (self.rows, self.columns), strict=True
        ):
            shown = np.unique(number[held])
            squared.append((lines[shown] ** 2).sum(axis=1) + (spreads[:, shown] ** 2).mean(axis=0).sum(axis=1))
        common = np.stack([state, *draws])[:, self.at_pairs : self.at_lens].reshape(len(draws) + 1, -1, 2)
        agreeing = np.unique(self.links.pair[weights > 0.25])
        squared.append(((common[0] ** 2 + (common[1:] ** 2).mean(axis=0)).sum(axis=1))[agreeing])
        variances = []
        for values, before in zip(squared, (usual, usual, usual, _PAIR_STD**2), strict=True):
            count = 1.0 / max(1, len(values))
            # Of Student's distribution, by a few steps from the median.
            scale = float(np.median(values)) / _MEDIAN if len(values) else before
            for _ in range(5):
                tails = (_TAILS + 2.0) / (_TAILS + values / max(scale, 1e-9))
                scale = (0.5 * float((tails * values).sum()) + count * before) / (len(values) + count)
            variances.append(scale)
        return np.array(variances)

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
        _, draws = self.solve(state, weights, noise, variances, _SAMPLES[1])
        deviation = 0.0 if given else math.inf
        if self.free_lens:
            deviation = float(draws[:, self.at_lens].std())
        tile_std, row_std, column_std, _ = np.sqrt(variances).tolist()
        rows, columns = self._lines(state)
        shown = (np.unique(number[self.linked]).size >= _LEAST_LINES for number in (self.rows, self.columns))
        line_stds = [std if enough else None for std, enough in zip((row_std, column_std), shown, strict=True)]
        matrix = state[self.at_matrix : self.at_pairs].reshape(2, 2)
        return Adjustment(
            state[: 2 * len(self.grid)].reshape(-1, 2) + self.middle,
            float(state[-1]),
            deviation,
            pair_weights,
            self.errors(state)[0],
            self.squared(state),
            noise,
            StageModel(matrix, rows, columns, line_stds[0], line_stds[1], tile_std),
            self._off_stage(state),
            draws[:, : 2 * len(self.grid)].reshape(len(draws), -1, 2),
        )
