"""Where the second tile of a pair may lie in the first, by correlation of coarse tiles."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.camera import Camera
from rdstitch.numerics.parabola import parabola_peak
from rdstitch.numerics.robust_loss import normal_std
from rdstitch.stage.coarse_tile import CoarseTile, coarse_tile
from rdstitch.stage.evidence import HUNDRED_TO_ONE, WRONG_PEAK, log_evidence, wide_peaks
from rdstitch.stage.grid import TileGrid
from rdstitch.stage.overlap import Overlap
from rdstitch.stage.phase_correlation import Surfaces, correlate, peak_threshold, peaks
from rdstitch.system.progress import Progress

Reader = Callable[[int], NDArray[Any]]
"""Gives a tile as it is registered, (h, w)."""

_Tile = TypeVar("_Tile")

# What is searched; sides are longer sides of tiles.
_COARSE_SIDE = 512  # pixels that are enough to find a displacement to a pixel of theirs
_SEARCH = 0.05  # of a side: displacement from the nominal place where the user does not say
_MIN_OVERLAP = 0.02  # of a side: overlap that is compared at least
_NARROW = 2  # coarse pixels: the radius of the window above whose noise peaks are kept
_CANDIDATES = 8  # highest peaks of a pair that are compared by normalized cross-correlation
_LENSES = np.linspace(-0.04, 0.04, 21)  # values of λ that are tried before it is estimated
_LENS_REACH = 0.02  # of a side: largest displacement of an overlap's blocks against each other by the lens
_MIN_CONTENT = 0.5  # share of the variance of a tile that must be content to look for it elsewhere


@dataclass(frozen=True)
class SearchPlan:
    """How neighbours are looked for."""

    grid: TileGrid
    search: float  # how far they may be off, pixels
    factor: int  # by which tiles are made smaller

    @classmethod
    def of(cls, grid: TileGrid, search: float | None = None) -> "SearchPlan":
        """Plan the search within so many pixels that the user says, or a usual part of a tile."""
        side = max(grid.size)
        return cls(grid, _SEARCH * side if search is None else search, max(1, round(side / _COARSE_SIDE)))

    @property
    def stage_std(self) -> float:
        """Standard deviation of where the stage goes, pixels, of which the search is three."""
        return self.search / 3.0


@dataclass(frozen=True, eq=False)
class Candidates:
    """Where the second tile of a pair may be in the first."""

    offsets: FloatArray  # (K, 2), pixels
    nats: FloatArray  # (K,): evidence for each, see :func:`log_evidence`
    grain: float  # pixels within which two of them are one

    def distinct_from(self, index: int) -> BoolArray:
        """Which of them (K,) are another place than one of them."""
        return np.asarray(np.abs(self.offsets - self.offsets[index]).max(axis=1) > self.grain)

    def best_elsewhere(self, index: int) -> float:
        """The most evidence, nats, for any other place than one of them; 0 for none."""
        return float(self.nats[self.distinct_from(index)].max(initial=0.0))


class PairFinder:
    """Looks for the second tile of each pair in the first, on coarse tiles."""

    def __init__(self, plan: SearchPlan, pairs: IntArray) -> None:
        self.grid, self.pairs, self.factor, side = plan.grid, pairs, plan.factor, max(plan.grid.size)
        self.radius = max(2, math.ceil(plan.search / plan.factor))
        self.spare = math.ceil(_LENS_REACH * side / plan.factor)
        self.least = math.ceil(_MIN_OVERLAP * side)
        self.sizes = plan.grid.sizes
        self.coarse = Camera((-(-self.grid.size[0] // plan.factor), -(-self.grid.size[1] // plan.factor)))

    def overlap(self, number: int, offset: FloatArray | None = None, scale: int | None = None) -> Overlap:
        """What the tiles of a pair have in common with the second at an offset, by default where the grid has it."""
        scale = scale or self.factor
        first, second = self.pairs[number].tolist()
        if offset is None:
            offset = self.grid.places[second] - self.grid.places[first]
        sizes = -(-self.sizes[[first, second]] // scale)
        return Overlap.expected(offset / scale, sizes, self.least // scale)

    def candidates(self, read: Reader, known: float | None, progress: Progress) -> tuple[list[Candidates], float]:
        """Candidates of all pairs, and the λ by which they were found; where that is unknown, twice if need be."""
        lens, scans = known or 0.0, known is None and self.grid.tile_sizes is None
        candidates_of_pairs, heights = self._each(read, lens, progress, scans=scans)
        middle, best = len(_LENSES) // 2, int(heights.sum(axis=0).argmax())
        if best != middle and (heights[:, best] > heights[:, middle]).all():
            lens = float(_LENSES[best])
            candidates_of_pairs, _ = self._each(read, lens, progress, scans=False)
        return candidates_of_pairs, lens

    def _each(
        self, read: Reader, lens: float, progress: Progress, *, scans: bool
    ) -> tuple[list[Candidates], FloatArray]:
        """Candidates of all pairs for a λ; of the lenses, the sums of peaks (2, L) along rows and along columns."""
        camera, heights = self.coarse.with_coefficients(lens), np.zeros((2, len(_LENSES)))
        candidates = []
        pairs = in_pairs(lambda index: coarse_tile(read(index), self.factor), self.pairs)
        for number, tiles in enumerate(pairs):
            overlap = self.overlap(number)
            surfaces = correlate(tiles[0].pixels, tiles[1].pixels, overlap, self.radius + self.spare)
            if scans:
                heights[int(np.abs(overlap.offset).argmax())] += self._heights(surfaces, overlap)
            candidates.append(self._of_pair(number, tiles, surfaces, camera))
            progress("correlating", number + 1, len(self.pairs))
        return candidates, heights

    def _heights(self, surfaces: Surfaces, overlap: Overlap) -> FloatArray:
        """The highest peak of a pair by each of the lenses (L,); 0 where all of them are noise."""
        lenses = [self.coarse.with_coefficients(lens) for lens in _LENSES]
        totals = np.array([surfaces.total(_shifts(overlap, lens), self.radius) for lens in lenses])
        heights = totals.max(axis=(1, 2))
        return np.asarray(heights * (heights.max() > _threshold(totals[len(_LENSES) // 2], self.radius)))

    def _of_pair(
        self, number: int, tiles: tuple[CoarseTile, CoarseTile], surfaces: Surfaces, lens: Camera
    ) -> Candidates:
        """Peaks of the correlation by their evidence; of any place in the tiles where none of them has much."""
        overlap, grain = self.overlap(number), min(tile.grain for tile in tiles)
        likely, further = self._peaks(surfaces, _shifts(overlap, lens), grain)
        offsets: list[FloatArray] = []
        nats: list[float] = []
        for at in (*likely, *further):
            offset = overlap.offset + at - self.radius
            there = self.overlap(number, offset * self.factor)
            value = log_evidence(tiles, there, offset, _shifts(there, lens))
            if len(offsets) < len(likely) or value > HUNDRED_TO_ONE:
                offsets.append(offset)
                nats.append(value)
        if max(nats, default=0.0) < WRONG_PEAK and min(tile.content_fraction for tile in tiles) > _MIN_CONTENT:
            places, values = wide_peaks(tiles)
            offsets, nats = [*offsets, *places], [*nats, *values.tolist()]
        return Candidates(self.factor * np.array(offsets).reshape(-1, 2), np.array(nats), self.factor * grain)

    def _peaks(self, surfaces: Surfaces, shifts: FloatArray, grain: float) -> tuple[list[FloatArray], list[FloatArray]]:
        """Places (2,) in the window of the peaks of the whitened correlation, and of other ones of the plain one."""
        total, inner = surfaces.total(shifts, self.radius), slice(self.spare, self.spare + 2 * self.radius + 1)
        plain = surfaces.plain[inner, inner].astype(np.float64)
        likely = [_vertex(total, *at) for at in peaks(total, _threshold(total, _NARROW), _CANDIDATES)]
        # Of a repeated pattern all places are alike, whichever of them a whitened correlation makes higher.
        further = [_vertex(plain, *at) for at in peaks(plain, 0.0, _CANDIDATES)]
        return likely, [at for at in further if all(np.abs(at - other).max() > grain for other in likely)]


def _vertex(surface: FloatArray, x: int, y: int) -> FloatArray:
    """Place of a peak to a fraction of a pixel along each axis."""
    lines = (surface[y], x), (surface[:, x], y)
    return np.array(
        [k + float(parabola_peak(*line[k - 1 : k + 2])[0]) if 0 < k < len(line) - 1 else k for line, k in lines],
        dtype=np.float64,
    )


def in_pairs(read: Callable[[int], _Tile], pairs: IntArray) -> Iterator[tuple[_Tile, _Tile]]:
    """The tiles of each pair; each is read when it is first needed, and kept until its last pair has been."""
    last = {int(tile): number for number, pair in enumerate(pairs) for tile in pair}
    held: dict[int, _Tile] = {}
    for number, pair in enumerate(pairs.tolist()):
        for tile in pair:
            if tile not in held:
                held[tile] = read(tile)
        yield held[pair[0]], held[pair[1]]
        for tile in pair:
            if last[tile] == number:
                del held[tile]


def _shifts(overlap: Overlap, camera: Camera) -> FloatArray:
    """Displacement of each block of an overlap (K, 2) by the lens, mean 0."""
    first = overlap.centers
    bent = [camera.undistort(points) - points for points in (first, first - overlap.offset)]
    shifts = bent[1] - bent[0]
    return np.asarray(shifts - shifts.mean(axis=0))


def _threshold(total: FloatArray, radius: int) -> float:
    """Height that a peak of noise hardly reaches within a window."""
    return peak_threshold(normal_std(total), (2 * radius + 1) ** 2)
