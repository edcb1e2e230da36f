"""Which way a stage's axes run in the image, and how far its steps go, by the strongest pairs of neighbours."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.stage.coarse_tile import CoarseTile
from rdstitch.stage.evidence import HUNDRED_TO_ONE, MIN_AXES_EVIDENCE, wide_peaks
from rdstitch.stage.grid import TileGrid
from rdstitch.stage.pair_candidates import Candidates

_TRIED = 48  # pairs of an axis that are compared at most
_ENOUGH = 8  # of these, pairs with evidence that are enough
_MIN_RATIO = 1.2  # of evidence for other axes to that for the nominal ones: where one is right its pairs agree in both
_ACROSS = 2.0  # times as far as along a step neighbours may be off across it
_MAX_SKEW = 0.1  # radians that the two axes may be off it
_SIMILAR = 0.2  # share by which the steps of pairs may differ to be compared with each other


@dataclass(frozen=True, eq=False)
class _Axis:
    """What pairs of neighbours along one of the stage's axes show."""

    step: FloatArray  # (2,): nominal, pixels
    measured: FloatArray  # (P, 2): where the second tile of a pair is in the first
    nats: FloatArray  # (P,): that it is there and not anywhere else

    def evidence(self, step: FloatArray, tolerance: float) -> float:
        """Nats for a step, over all pairs."""
        return float(self.nats[self._near(step, tolerance)].sum())

    def _near(self, step: FloatArray, tolerance: float) -> BoolArray:
        """Pairs that show a step; across it rows that are taken to and fro have their backlash twice."""
        across = 1.0 + _ACROSS * (np.arange(2) != np.abs(step).argmax())
        return np.asarray((np.abs(self.measured - step) <= tolerance * across).all(axis=1))

    def steps(self, tolerance: float, count: int = 4) -> list[FloatArray]:
        """The steps with the most evidence, unlike each other, along an axis of the image; the most first."""
        chosen: list[FloatArray] = []
        for step in sorted(self.measured, key=lambda step: -self.evidence(step, tolerance)):
            if len(chosen) < count and all(np.abs(step - other).max() > tolerance for other in chosen):
                middle = np.median(self.measured[self._near(step, tolerance)], axis=0)
                chosen.append(np.where(np.arange(2) == np.abs(middle).argmax(), middle, 0.0))
        return chosen


@dataclass(frozen=True)
class MeasuredAxis:
    """What tiles show of an axis of a grid that is not as it was given."""

    swapped: bool  # columns lie below each other, or rows beside each other
    mirrored: bool  # the next one is on the other side
    overlap: float  # of neighbours, fraction of a side


def with_measured_axes(
    grid: TileGrid, read: Callable[[int], CoarseTile], factor: int, search: float
) -> tuple[TileGrid, dict[int, MeasuredAxis]]:
    """The grid as its tiles show it, and its axes, 0 for columns and 1 for rows, if they are clearly not as given.

    ``read`` gives tiles whose pixels are ``factor`` of the grid's; within ``search`` pixels it is as given.
    """
    axes = {k: axis for k in (0, 1) if (axis := _axis(grid, k, read, factor)) is not None}

    def evidence(steps: Sequence[FloatArray]) -> float:
        return sum(axis.evidence(step, search) for axis, step in zip(axes.values(), steps, strict=True))

    nominal, *alternatives = product(*([axis.step, *axis.steps(search)] for axis in axes.values()))
    best = max([nominal, *(steps for steps in alternatives if len(steps) < 2 or _perpendicular(*steps))], key=evidence)
    if evidence(best) < max(MIN_AXES_EVIDENCE, _MIN_RATIO * evidence(nominal)) or all(
        np.abs(measured - step).max() <= search for measured, step in zip(best, nominal, strict=True)
    ):
        return grid, {}
    before, after = np.eye(2), np.eye(2)  # rows: from one column, or row, of the grid to the next, pixels
    for (k, axis), measured in zip(axes.items(), best, strict=True):
        before[k], after[k] = axis.step, measured
    for k, axis in axes.items():
        if len(axes) == 2 and axis.evidence(best[k], search) == 0.0:
            after[k] = _across(before[k], before[1 - k], best[1 - k])
    places = grid.places @ np.linalg.solve(before, after)
    turned = replace(grid, places=places - places.min(axis=0))
    return turned, {k: _measured(k, before[k], after[k], grid.size) for k in axes}


def _axis(grid: TileGrid, axis: int, read: Callable[[int], CoarseTile], factor: int) -> _Axis | None:
    """Neighbours along an axis of the grid; None where it has none."""
    cells = {cell: k for k, cell in enumerate(zip(grid.columns.tolist(), grid.rows.tolist(), strict=True))}
    adjacent = ((k, cells.get((c + 1, r) if axis == 0 else (c, r + 1))) for (c, r), k in cells.items())
    pairs: IntArray = np.array([pair for pair in adjacent if pair[1] is not None], dtype=np.intp).reshape(-1, 2)
    if not len(pairs):
        return None
    off = grid.places[pairs[:, 1]] - grid.places[pairs[:, 0]]
    step = np.median(off, axis=0)
    pairs = pairs[np.abs(off - step).max(axis=1) <= _SIMILAR * np.linalg.norm(step)]
    # Spread over the grid, whatever the number that will be compared: multiples of the golden section.
    order = np.argsort((np.arange(len(pairs)) * (math.sqrt(5.0) - 1.0) / 2.0) % 1.0, kind="stable")
    measured, margins = [], []
    for first, second in pairs[order[:_TRIED]].tolist():
        tiles = read(first), read(second)
        places, nats = wide_peaks(tiles)
        if len(nats):
            best = int(nats.argmax())
            candidates = Candidates(places, nats, min(tile.grain for tile in tiles))
            measured.append(places[best] * factor)
            margins.append(max(0.0, float(nats[best]) - candidates.best_elsewhere(best)))
            if sum(margin > HUNDRED_TO_ONE for margin in margins) == _ENOUGH:
                break
    return _Axis(np.asarray(step), np.array(measured).reshape(-1, 2), np.array(margins))


def _perpendicular(x: FloatArray, y: FloatArray) -> bool:
    return bool(abs(x @ y) <= math.sin(_MAX_SKEW) * np.linalg.norm(x) * np.linalg.norm(y))


def _across(nominal: FloatArray, other: FloatArray, other_measured: FloatArray) -> FloatArray:
    """Derive a step that no pair shows from the other: perpendicular to that, and as much longer as nominally."""
    longer = float(np.linalg.norm(nominal) / np.linalg.norm(other))
    across = np.array([-other_measured[1], other_measured[0]]) * longer
    # On the side of the nominal one if there is such a side.
    return across if float(across @ nominal) >= 0.0 else -across


def _measured(axis: int, nominal: FloatArray, measured: FloatArray, size: tuple[int, int]) -> MeasuredAxis:
    along = int(np.abs(measured).argmax())
    mirrored = bool(measured[along] * nominal[axis] < 0.0)
    return MeasuredAxis(along != axis, mirrored, 1.0 - abs(float(measured[along])) / size[along])
