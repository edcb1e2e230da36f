"""All places at once: links by their matches, and the stage as a prior whose variances are estimated from the grid.

A tile lies at ``t = A n + row + column + ε``: n is its nominal place, A the camera's turn and scale
against the stage's axes, row and column what each line is off as a whole (backlash), ε the rest. The variances of
these three are estimated with the places (expectation maximization), so that a tile without links has the place that
the model of the stage gives it.
"""

import math
from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.numerics.robust_loss import RAYLEIGH_MEDIAN
from rdstitch.stage.equations import LinkedPoints, StageEquations, StageState, Variances
from rdstitch.stage.grid import TileGrid

_ROUNDS = 12
_GENEROUS = 20.0  # widths of the robust loss in the first round; it is halved until it is 1
_WIDTH = 4.0  # standard deviations at which a link counts a quarter: Geman and McClure's loss
_SQUARED_MEDIAN = RAYLEIGH_MEDIAN**2  # of the sum of two squared standard normal numbers
_PAIR_STD = 0.03  # standard deviation of an error that all blocks of a pair share, pixels, before it is estimated
_AGREEING_WEIGHT = 0.1  # of a block from which on the noise is also by it
_MIN_NOISE = 0.1  # of the variances that blocks have by their information
_SAMPLES = 16  # draws from the posterior, to estimate the variances of the stage
_RESULT_SAMPLES = 64  # draws in the result, so that every ± that is made of them is itself known to 9 %
_HOLDING_WEIGHT = 0.25  # of a block, or a pair, from which on it holds its tiles
_TAILS = 4.0  # degrees of freedom of the places about the stage's model: a few tiles may be far off
_MIN_LINES = 4  # rows or columns whose errors show what rows or columns are off


@dataclass(frozen=True, eq=False)
class StageModel:
    """Errors of the stage."""

    matrix: FloatArray  # (2, 2): from pixels of the nominal places to pixels of the camera
    rows: FloatArray  # rows, columns: (R, 2) and (C, 2): what each line is off as a whole, pixels
    columns: FloatArray
    row_std: float | None  # row_std, column_std: standard deviations of those, where enough lines show them
    column_std: float | None
    std: float  # of what is left of each tile


@dataclass(frozen=True, eq=False)
class Adjustment:
    """The places of all tiles, and the model of the stage that they were fitted with."""

    places: FloatArray  # (N, 2): of the undistorted tiles, pixels
    distortion: float  # λ in the half-diagonal frame
    distortion_std: float  # inf where nothing shows it
    weights: FloatArray  # (P,): of each pair, 0 for one that contradicts the others, 1 for one that agrees
    residuals: FloatArray  # (M, 2): undistorted pixels
    squared: FloatArray  # (M,): squared errors of the blocks, in variances by their information
    noise: float  # how much larger they are in the median than by that
    stage: StageModel
    off_stage: FloatArray  # (N, 2): what each tile is off against the model of the stage
    deviations: FloatArray  # (S, N, 2): draws of the errors of the places, pixels

    @property
    def holding(self) -> BoolArray:
        """Which pairs hold their tiles where they are (P,); the others contradict them."""
        return self.weights > _HOLDING_WEIGHT

    @property
    def agreeing(self) -> BoolArray:
        """Which blocks are where the places put them, as far as their noise goes (M,)."""
        return self.squared / self.noise < _WIDTH**2

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
    """Adjust all places by λ, held unless the lens is free; at first a tile may be ``stage_std`` pixels off."""
    equations = StageEquations(grid, links, free_lens=free_lens)
    state = equations.start(distortion)
    usual = Variances(stage_std**2, stage_std**2, stage_std**2, _PAIR_STD**2)
    variances = usual
    weights, pair_weights = np.ones(len(links.pair)), np.ones(len(links.tiles))
    width, noise = _GENEROUS, 1.0
    for _ in range(_ROUNDS):
        state, draws = equations.solve(state, weights, noise, variances, _SAMPLES)
        variances = _variances(equations, state, draws, weights, usual)
        width = max(width / 2.0, 1.0)
        weights, pair_weights, noise = _reweighted(equations, state, weights, width)
    _, draws = equations.solve(state, weights, noise, variances, _RESULT_SAMPLES)
    linked = np.unique(links.tiles)
    row_std, column_std = (
        math.sqrt(variance) if np.unique(lines[linked]).size >= _MIN_LINES else None
        for lines, variance in ((equations.rows, variances.row), (equations.columns, variances.column))
    )
    return Adjustment(
        places=state.places + equations.middle,
        distortion=float(state.lens[0]),
        distortion_std=float(draws.lens.std()) if free_lens else math.inf,
        weights=pair_weights,
        residuals=equations.errors(state)[0],
        squared=equations.squared(state),
        noise=noise,
        stage=StageModel(state.matrix, state.rows, state.columns, row_std, column_std, math.sqrt(variances.tile)),
        off_stage=equations.off_stage(state),
        deviations=draws.places,
    )


def _reweighted(
    equations: StageEquations, state: StageState, weights: FloatArray, width: float
) -> tuple[FloatArray, FloatArray, float]:
    """Weights of blocks and of pairs by a loss of a width, and the noise of the blocks that agreed by the weights."""
    squared, of_blocks = equations.squared(state), equations.squared(state, of_blocks=True)
    agreeing = weights > _AGREEING_WEIGHT
    noise, excess = (
        max(float(np.median(values[agreeing])) / _SQUARED_MEDIAN if agreeing.any() else 1.0, least)
        for values, least in ((of_blocks, _MIN_NOISE), (squared, 1.0))
    )
    scale = excess * (width * _WIDTH) ** 2
    pair_weights = 1.0 / (1.0 + equations.links.medians(squared) / scale) ** 2
    return pair_weights[equations.links.pair] / (1.0 + squared / scale) ** 2, pair_weights, noise


def _variances(
    equations: StageEquations, state: StageState, draws: StageState, weights: FloatArray, usual: Variances
) -> Variances:
    """Variances of tiles, rows, columns and pairs by those that links hold: the fewer, the more ``usual`` counts."""
    agreeing = weights > _HOLDING_WEIGHT

    def squared(values: FloatArray, errors: FloatArray, chosen: IntArray) -> FloatArray:
        """Expected squares of some of the vectors (K, 2), of which ``errors`` (S, K, 2) are draws."""
        return np.asarray(((values**2).sum(axis=1) + (errors**2).mean(axis=0).sum(axis=1))[np.unique(chosen)])

    held = np.union1d(equations.first[agreeing], equations.second[agreeing])
    return Variances(
        tile=_students_variance(squared(equations.off_stage(state), equations.off_stage(draws), held), usual.tile),
        row=_students_variance(squared(state.rows, draws.rows, equations.rows[held]), usual.row),
        column=_students_variance(squared(state.columns, draws.columns, equations.columns[held]), usual.column),
        pair=_students_variance(squared(state.shared, draws.shared, equations.links.pair[agreeing]), usual.pair),
    )


def _students_variance(squares: FloatArray, usual: float) -> float:
    """Variance of a coordinate by squared lengths of vectors, as of Student's distribution; as usual without any."""
    count = 1.0 / max(1, len(squares))
    variance = float(np.median(squares)) / _SQUARED_MEDIAN if len(squares) else usual
    for _ in range(5):
        tails = (_TAILS + 2.0) / (_TAILS + squares / max(variance, 1e-9))
        variance = (0.5 * float((tails * squares).sum()) + count * usual) / (len(squares) + count)
    return variance
