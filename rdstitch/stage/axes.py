"""Which way a stage's axes run in the image, and how far its steps go, by the strongest pairs of neighbours."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.stage.correlation import CoarseTile, wide_peaks
from rdstitch.stage.grid import TileGrid

_TRIED, _ENOUGH = 48, 8  # pairs of an axis that are compared at most, and those with evidence that are enough
# factor of evidence that other axes must have: of two where one is right, the pairs along it agree in both
_MIN_RATIO = 1.2
_MIN_EVIDENCE = 10.0  # evidence below which nothing is known, about one overlap of a correlation of 0.9
_PEAK_MARGIN = 4.6  # nats by which a peak that stands out is above the others of its pair: a hundred to one
_ACROSS = 2.0  # times as far as along a step neighbours may be off across it
_MAX_SKEW = 0.1  # radians that the two axes may be off it
_SIMILAR = 0.2  # share by which the steps of pairs may differ to be compared with each other


@dataclass(frozen=True, eq=False)
class _Axis:
    """What pairs of neighbours along one of the stage's axes show."""

    step: FloatArray  # (2,): nominal, pixels
    # (P, 2): where the second tile of a pair is in the first, and (P,): nats that it is there and not anywhere else
    shown: FloatArray
    nats: FloatArray

    def evidence(self, step: FloatArray, tolerance: float) -> float:
        """Nats for a step, over all pairs."""
        return float(self.nats[self._near(step, tolerance)].sum())

    def _near(self, step: FloatArray, tolerance: float) -> BoolArray:
        """Pairs that show a step; across it rows that are taken to and fro have their backlash twice."""
        across = 1.0 + _ACROSS * (np.arange(2) != np.abs(step).argmax())
        return np.asarray((np.abs(self.shown - step) <= tolerance * across).all(axis=1))

    def steps(self, tolerance: float, count: int = 4) -> list[FloatArray]:
        """The steps with the most evidence, unlike each other, along an axis of the image; the most first."""
        chosen: list[FloatArray] = []
        for step in sorted(self.shown, key=lambda step: -self.evidence(step, tolerance)):
            if len(chosen) < count and all(np.abs(step - other).max() > tolerance for other in chosen):
                middle = np.median(self.shown[self._near(step, tolerance)], axis=0)
                chosen.append(np.where(np.arange(2) == np.abs(middle).argmax(), middle, 0.0))
        return chosen


def with_axes_shown(
    grid: TileGrid, read: Callable[[int], CoarseTile], factor: int, search: float
) -> tuple[TileGrid, str]:
    """The grid as its tiles show it, and in words what it is not as told; unchanged, and "", unless clearly otherwise.

    ``read`` gives tiles whose pixels are ``factor`` of the grid's; within ``search`` pixels the grid is as told.
    """
    axes = [_axis(grid, axis, read, factor) for axis in (0, 1)]
    told = [None if axis is None else axis.step for axis in axes]
    choices = [[None] if axis is None else [axis.step, *axis.steps(search)] for axis in axes]

    def evidence(steps: Sequence[FloatArray | None]) -> float:
        pairs = zip(axes, steps, strict=True)
        return sum(axis.evidence(step, search) for axis, step in pairs if axis is not None and step is not None)

    nominal = evidence(told)
    most, best = nominal, told
    for x in choices[0]:
        for y in choices[1]:
            if (x is None or y is None or _perpendicular(x, y)) and (score := evidence((x, y))) > most:
                most, best = score, [x, y]
    if (
        most < max(_MIN_EVIDENCE, _MIN_RATIO * nominal)
        or best is told
        or all(s is None or t is None or np.abs(s - t).max() <= search for s, t in zip(best, told, strict=True))
    ):
        return grid, ""
    steps = _completed(best, told, axes, search)
    before, after = (
        np.array([np.eye(2)[k] if step is None else step for k, step in enumerate(pair)]) for pair in (told, steps)
    )
    places = grid.places @ np.linalg.solve(before, after)
    turned = replace(grid, places=places - places.min(axis=0))
    return turned, _in_words(steps, told, grid.size)


def _axis(grid: TileGrid, axis: int, read: Callable[[int], CoarseTile], factor: int) -> _Axis | None:
    """Neighbours along an axis of the grid; None where it has none."""
    cells = {cell: k for k, cell in enumerate(zip(grid.columns.tolist(), grid.rows.tolist(), strict=True))}
    beside = ((k, cells.get((c + 1, r) if axis == 0 else (c, r + 1))) for (c, r), k in cells.items())
    pairs: IntArray = np.array([pair for pair in beside if pair[1] is not None], dtype=np.intp).reshape(-1, 2)
    if not len(pairs):
        return None
    off = grid.places[pairs[:, 1]] - grid.places[pairs[:, 0]]
    step = np.median(off, axis=0)
    pairs = pairs[np.abs(off - step).max(axis=1) <= _SIMILAR * np.linalg.norm(step)]
    # Spread over the grid, whatever the number that will be compared: multiples of the golden section.
    order = np.argsort((np.arange(len(pairs)) * (math.sqrt(5.0) - 1.0) / 2.0) % 1.0, kind="stable")
    shown, margins = [], []
    for first, second in pairs[order[:_TRIED]].tolist():
        tiles = read(first), read(second)
        places, nats = wide_peaks(tiles)
        if len(nats):
            best = int(nats.argmax())
            others = nats[np.abs(places - places[best]).max(axis=1) > min(tile.grain for tile in tiles)]
            shown.append(places[best] * factor)
            margins.append(max(0.0, float(nats[best] - others.max(initial=0.0))))
            if sum(margin > _PEAK_MARGIN for margin in margins) == _ENOUGH:
                break
    return _Axis(np.asarray(step), np.array(shown).reshape(-1, 2), np.array(margins))


def _perpendicular(x: FloatArray, y: FloatArray) -> bool:
    return bool(abs(x @ y) <= math.sin(_MAX_SKEW) * np.linalg.norm(x) * np.linalg.norm(y))


def _completed(
    steps: Sequence[FloatArray | None], told: Sequence[FloatArray | None], axes: Sequence[_Axis | None], search: float
) -> list[FloatArray | None]:
    """The steps; one that no pair shows follows the other in direction and length."""
    completed = list(steps)
    for k in (0, 1):
        step, other, own, others = steps[k], steps[1 - k], told[k], told[1 - k]
        if step is None or other is None or own is None or others is None:
            continue
        axis = axes[k]
        if axis is None or axis.evidence(step, search) == 0.0:
            # Perpendicular, on the side where it was told to be if that is one.
            across = np.array([-other[1], other[0]]) * float(np.linalg.norm(own) / np.linalg.norm(others))
            completed[k] = across if float(across @ own) >= 0.0 else -across
    return completed


def _in_words(steps: Sequence[FloatArray | None], told: Sequence[FloatArray | None], size: tuple[int, int]) -> str:
    """What is not as told: directions, and overlaps."""
    said, overlaps = [], []
    for k, (one, many) in enumerate((("column", "columns"), ("row", "rows"))):
        step, known = steps[k], told[k]
        if step is None or known is None:
            continue
        along = int(np.abs(step).argmax())
        if along != k:
            said.append(f"{many} lie {'below' if along else 'beside'} each other")
        if step[along] * known[k] < 0.0:
            said.append(f"the next {one} is {('left', 'above')[along]}")
        overlaps.append(f"{100.0 * (1.0 - abs(step[along]) / size[along]):.1f}")
    return f"{', '.join([*said, ''])}neighbours overlap by {' and '.join(overlaps)} %"
