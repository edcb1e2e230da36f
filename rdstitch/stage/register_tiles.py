"""From nominal places and tiles to all places: correlate, learn the stage, refine, adjust."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.camera import Camera
from rdstitch.robust.loss import normal_std
from rdstitch.stage.adjustment import Adjustment, adjust
from rdstitch.stage.correlation import (
    CoarseTile,
    Overlap,
    coarse_tile,
    correlate,
    log_evidence,
    peak_threshold,
    peaks,
    wide_peaks,
)
from rdstitch.stage.grid import TileGrid
from rdstitch.stage.linked_points import LinkedPoints
from rdstitch.stage.refinement import BlockMatches, Transfer, refine
from rdstitch.system.late_imports import csgraph, sparse
from rdstitch.system.progress import Progress, silent

Reader = Callable[[int], NDArray[Any]]
"""Gives a tile as it is registered, (h, w)."""

_Tile = TypeVar("_Tile")

# What is searched; sides are longer sides of tiles.
_COARSE_SIDE = 512  # pixels that are enough to find a displacement to a pixel of theirs
_SEARCH = 0.05  # of a side: displacement from the nominal place where the user does not say
_MIN_OVERLAP = 0.02  # of a side: overlap that is compared at least
_NARROW = 2  # coarse pixels about where others say that a pair is: peaks are kept above the noise of so few
_CANDIDATES = 8  # highest peaks of a pair that are compared by normalized cross-correlation
_ROUNDS = 4  # by which what is certain of the stage decides about what was not

# What decides about a place of a pair. Evidence is in nats: logarithms of odds.
_POOR = 6.0  # nats below which a pair is looked for elsewhere: a correlation of about 0.6
_RIVAL = 4.6  # nats from which on a place is possible that the whitened correlation does not show: 100 to 1
_SURE = math.log(99.0)  # nats of one place of a pair against all others that are possible
_MOVED = math.log(1e-3)  # nats for that a tile is anywhere but where its stage was sent, within its errors
_MIN_CONTENT = 0.5  # share of the variance of a tile that must be content to look for it elsewhere
_AGREES = 0.25  # weight of a pair from which on it holds its tiles
_MAX_STD = 1.0  # coarse pixels: a refined place that is less sure than that was not found

# When a lens is taken to be there.
_LENSES = np.linspace(-0.04, 0.04, 21)  # values of λ that are tried before it is estimated
_LENS_REACH = 0.02  # of a side: largest displacement of an overlap's blocks against each other by the lens
_LENS_SHOWN = 5.0  # standard deviations that pairs along rows and pairs along columns must show each
_LENS_AGREES = 0.25  # of λ: by how much the two may differ beyond chance
_WHOLE_PIXEL = 0.5  # pixels by which a lens must move corners: leaving whole pixels costs as much


@dataclass(frozen=True, eq=False)
class TileRegistration:
    """The places of all tiles, and the matches that show them."""

    grid: TileGrid
    adjustment: Adjustment
    links: LinkedPoints  # blocks of all pairs that show something
    compared: IntArray  # (Q, 2), int: all pairs that were compared
    # (N,), bool: tiles that links hold; the others have the place that the model of the stage gives them
    linked: BoolArray
    groups: tuple[tuple[int, ...], ...]  # tiles that links hold together, the largest group first
    search: float  # how far neighbours were looked for, pixels
    z: int | Literal["max"] | None = None  # z, time: plane and time of the files that were read, where they were chosen
    time: int | None = None

    @property
    def stds(self) -> FloatArray:
        """Standard deviation of each tile's place against the largest group, in x and in y, pixels (N,)."""
        group = self.groups[0] if self.groups else range(len(self.grid))
        return self.adjustment.stds(np.array(group))

    @property
    def off_stage(self) -> FloatArray:
        """How far each tile is from where the model of the stage has it, pixels (N,)."""
        return np.asarray(np.linalg.norm(self.adjustment.off_stage, axis=1))

    @property
    def mostly_nominal(self) -> bool:
        """Whether more tiles have their places from the stage alone than from what they show."""
        return 2 * int(self.linked.sum()) < len(self.grid)


@dataclass(frozen=True)
class SearchPlan:
    """How neighbours are looked for."""

    grid: TileGrid
    search: float  # how far they may be off, pixels
    factor: int  # by which tiles are made smaller

    @classmethod
    def of(cls, grid: TileGrid, search: float | None = None) -> "SearchPlan":
        """By what the user says of the search, or as usual."""
        side = max(grid.size)
        return cls(grid, _SEARCH * side if search is None else search, max(1, round(side / _COARSE_SIDE)))

    @property
    def stage_std(self) -> float:
        """Standard deviation of where the stage goes, pixels, of which the search is three."""
        return self.search / 3.0


def register_tiles(
    plan: SearchPlan,
    read: Reader,
    *,
    distortion: float | Literal["auto"] | None = None,
    progress: Progress = silent,
) -> TileRegistration:
    """Find the places of all tiles.

    ``distortion`` is λ where it is known, "auto" where it is to be estimated; otherwise it is 0 unless pairs along rows
    and pairs along columns show the same.
    """
    pairs = plan.grid.neighbours(plan.search)
    known = distortion if isinstance(distortion, float | int) else None
    finder = _PairFinder(plan, pairs)
    candidates, lens = finder.candidates(read, known, progress)
    chosen, rough = _chosen(pairs, candidates, plan, lens)
    if not chosen:
        return _result(plan, pairs, LinkedPoints.of(pairs, {}), rough)
    matches: dict[int, BlockMatches] = {}
    camera = Camera(plan.grid.size, lens)
    tiles = _in_pairs(read, pairs[list(chosen)])
    for count, ((number, offset), (one, two)) in enumerate(zip(chosen.items(), tiles, strict=True)):
        overlap = finder.overlap(number, offset, 1)
        for cells in (overlap.cells(plan.grid.size), overlap.whole):
            cut = replace(overlap, blocks=cells)
            refined = refine(one, two, cells, _transfer(cut, offset, camera), plan.factor + 1.5)
            # What is less sure than the coarse place was not found by looking around that.
            if refined.std < _MAX_STD * plan.factor:
                matches[number] = refined
                break
        progress("refining", count + 1, len(chosen))
    links = LinkedPoints.of(pairs, matches)
    return _result(plan, pairs, links, _with_lens(plan, links, lens, distortion))


def _with_lens(
    plan: SearchPlan, links: LinkedPoints, lens: float, wanted: float | Literal["auto"] | None
) -> Adjustment:
    """All places, with λ where it is asked for, or where it is there."""
    grid, std = plan.grid, plan.stage_std
    if isinstance(wanted, float | int):
        return adjust(grid, links, std, float(wanted))
    straight = adjust(grid, links, std)
    if not len(links.pair) or grid.own_sizes is not None:
        return straight
    bent = adjust(grid, links, std, lens, free_lens=True)
    better = straight.cost(bent.noise) - bent.cost(bent.noise) > math.log(max(2, len(links.pair)))
    moved = abs(bent.distortion) * math.hypot(*grid.size) / 2.0
    if wanted == "auto" or (better and moved > _WHOLE_PIXEL and _lens_is_there(grid, links, std, bent.distortion)):
        return bent
    return replace(straight, distortion_std=max(bent.distortion_std, abs(bent.distortion)))


def _lens_is_there(grid: TileGrid, links: LinkedPoints, std: float, lens: float) -> bool:
    """Check whether pairs along rows and pairs along columns show the same λ: what else bends tiles does not."""
    off = np.abs(grid.places[links.tiles[:, 1]] - grid.places[links.tiles[:, 0]])
    shown = []
    for along in (off[:, 0] > off[:, 1], off[:, 0] <= off[:, 1]):
        part = links.of_pairs(along)
        if not len(part.pair):
            return False
        fitted = adjust(grid, part, std, lens, free_lens=True)
        shown.append((fitted.distortion, fitted.distortion_std))
    (a, a_std), (b, b_std) = shown
    apart = abs(a - b) <= max(_LENS_AGREES * abs(a + b) / 2.0, 3.0 * math.hypot(a_std, b_std))
    return apart and a * b > 0.0 and all(abs(value) > _LENS_SHOWN * deviation for value, deviation in shown)


@dataclass(frozen=True, eq=False)
class _Candidates:
    """Where the second tile of a pair may be in the first."""

    offsets: FloatArray  # (K, 2), pixels
    nats: FloatArray  # (K,): evidence for each, see :func:`log_evidence`
    grain: float  # pixels within which two of them are one

    def apart(self, index: int) -> BoolArray:
        """Which others (K,) are another place than one of them."""
        return np.asarray(np.abs(self.offsets - self.offsets[index]).max(axis=1) > self.grain)

    def best_besides(self, index: int) -> float:
        """The most evidence, nats, for any other place than one of them; 0 for none."""
        return float(self.nats[self.apart(index)].max(initial=0.0))


class _PairFinder:
    """Looks for the second tile of each pair in the first, on coarse tiles."""

    def __init__(self, plan: SearchPlan, pairs: IntArray) -> None:
        self.grid, self.pairs, self.factor = plan.grid, pairs, plan.factor
        grid, factor = plan.grid, plan.factor
        side = max(grid.size)
        self.radius = max(2, math.ceil(plan.search / factor))
        self.spare = math.ceil(_LENS_REACH * side / factor)
        self.least = math.ceil(_MIN_OVERLAP * side)
        self.sizes = grid.sizes
        self.coarse = Camera((-(-grid.size[0] // factor), -(-grid.size[1] // factor)))

    def overlap(self, number: int, offset: FloatArray | None = None, scale: int | None = None) -> Overlap:
        """What the tiles of a pair have in common with the second at an offset, by default where the grid has it."""
        scale = scale or self.factor
        first, second = self.pairs[number].tolist()
        if offset is None:
            offset = self.grid.places[second] - self.grid.places[first]
        sizes = -(-self.sizes[[first, second]] // scale)
        return Overlap.expected(first, second, offset / scale, sizes, self.least // scale)

    def candidates(self, read: Reader, known: float | None, progress: Progress) -> tuple[list[_Candidates], float]:
        """Candidates of all pairs, and the λ by which they were found; where that is unknown, twice if need be."""
        heights = np.zeros((2, len(_LENSES)))
        lens = known or 0.0
        found = self._each(read, lens, progress, heights if known is None and self.grid.own_sizes is None else None)
        middle = len(_LENSES) // 2
        best = int(heights.sum(axis=0).argmax())
        if best != middle and (heights[:, best] > heights[:, middle]).all():
            lens = float(_LENSES[best])
            found = self._each(read, lens, progress, None)
        return found, lens

    def _each(self, read: Reader, lens: float, progress: Progress, heights: FloatArray | None) -> list[_Candidates]:
        found = []
        pairs = _in_pairs(lambda index: coarse_tile(read(index), self.factor), self.pairs)
        for number, tiles in enumerate(pairs):
            found.append(self._of_pair(number, tiles, self.coarse.with_coefficients(lens), heights))
            progress("correlating", number + 1, len(self.pairs))
        return found

    def _of_pair(
        self, number: int, tiles: tuple[CoarseTile, CoarseTile], lens: Camera, heights: FloatArray | None
    ) -> _Candidates:
        overlap = self.overlap(number)
        surface = correlate(tiles[0].pixels, tiles[1].pixels, overlap, self.radius + self.spare)
        total = surface.total(_shifts(overlap, lens), self.radius)
        if heights is not None:
            tops = [
                surface.total(_shifts(overlap, self.coarse.with_coefficients(v)), self.radius).max() for v in _LENSES
            ]
            if max(tops) > _threshold(total, self.radius):
                heights[int(np.abs(overlap.offset).argmax())] += tops
        inner = slice(self.spare, self.spare + 2 * self.radius + 1)
        plain = surface.plain[inner, inner].astype(np.float64)
        likely = [_vertex(total, *at) for at in peaks(total, _threshold(total, _NARROW), _CANDIDATES)]
        # Of a repeated pattern all places are alike, whichever of them a whitened correlation makes higher.
        others = [_vertex(plain, *at) for at in peaks(plain, 0.0, _CANDIDATES)]
        grain = min(tile.grain for tile in tiles)
        others = [at for at in others if all(np.abs(at - other).max() > grain for other in likely)]
        offsets: list[FloatArray] = []
        nats: list[float] = []
        for at in (*likely, *others):
            offset = overlap.offset + at - self.radius
            there = self.overlap(number, offset * self.factor)
            value = log_evidence(tiles, there, offset, _shifts(there, lens))
            if len(offsets) < len(likely) or value > _RIVAL:
                offsets.append(offset)
                nats.append(value)
        if max(nats, default=0.0) < _POOR and min(tile.content_share for tile in tiles) > _MIN_CONTENT:
            places, values = wide_peaks(tiles)
            offsets, nats = [*offsets, *places], [*nats, *values.tolist()]
        return _Candidates(self.factor * np.array(offsets).reshape(-1, 2), np.array(nats), self.factor * grain)


def _vertex(surface: FloatArray, x: int, y: int) -> FloatArray:
    """Place of a peak to a fraction of a pixel, by a parabola through its neighbours along each axis."""
    place = np.array([x, y], dtype=np.float64)
    for axis, (line, k) in enumerate(((surface[y], x), (surface[:, x], y))):
        if 0 < k < len(line) - 1:
            before, at, after = line[k - 1 : k + 2]
            place[axis] += 0.5 * (before - after) / min(before + after - 2.0 * at, -1e-9)
    return place


def _chosen(
    pairs: IntArray, candidates: Sequence[_Candidates], plan: SearchPlan, lens: float
) -> tuple[dict[int, FloatArray], Adjustment]:
    """Where the second tile of a pair is in the first, by pair, where one place stands out; and all places by that.

    What is certain teaches what the stage does, and that decides among the places of the other pairs.
    """
    chosen: dict[int, FloatArray] = {}
    fitted = adjust(plan.grid, LinkedPoints.of(pairs, {}), plan.stage_std, lens)
    for count in range(_ROUNDS):
        before = dict(chosen)
        doubted = {number for number, weight in zip(chosen, fitted.weights, strict=True) if weight < _AGREES}
        for number, of_pair in enumerate(candidates):
            if not len(of_pair.nats) or (number in chosen and number not in doubted):
                continue
            chosen.pop(number, None)
            best, odds = _most_likely(of_pair, *fitted.between(pairs[number]), plan)
            # What is likely wherever the stage is goes first, and what is so only near where it should be second.
            if odds > _SURE and (count > 0 or of_pair.nats[best] > _RIVAL):
                chosen[number] = of_pair.offsets[best]
        chosen.update(_moved_tiles(pairs, candidates, fitted, chosen, plan.search))
        chosen = dict(sorted(chosen.items()))
        if count > 0 and {k: v.tolist() for k, v in chosen.items()} == {k: v.tolist() for k, v in before.items()}:
            break
        fitted = adjust(plan.grid, _coarse_links(pairs, chosen, plan), plan.stage_std, lens)
    return chosen, fitted


def _most_likely(
    candidates: _Candidates, expected: FloatArray, covariance: FloatArray, plan: SearchPlan
) -> tuple[int, float]:
    """The candidate that is likely the most where the stage leads one to expect it, and the logarithm of its odds."""
    covariance = covariance + np.eye(2) * (plan.factor / 2.0) ** 2
    off = candidates.offsets - expected
    log_prior = -0.5 * np.einsum("ki,ij,kj->k", off, np.linalg.inv(covariance), off) - 0.5 * math.log(
        (2.0 * math.pi) ** 2 * float(np.linalg.det(covariance))
    )
    anywhere = -math.log(float(np.prod(plan.grid.size)))
    score = candidates.nats + np.logaddexp(log_prior, _MOVED + anywhere)
    best = int(score.argmax())
    # Nothing of what was found may be right, either.
    others = np.append(score[candidates.apart(best)], anywhere)
    return best, float(score[best] - np.logaddexp.reduce(others))


class _Move(NamedTuple):
    """A candidate of a pair, as a move of one of its tiles away from where the stage was sent."""

    pair: int
    candidate: int  # its number among those of the pair
    nats: float


def _moved_tiles(
    pairs: IntArray, candidates: Sequence[_Candidates], fitted: Adjustment, chosen: dict[int, FloatArray], search: float
) -> dict[int, FloatArray]:
    """Places of pairs of tiles that are somewhere else, where nothing was chosen for any of a tile's pairs.

    No pair alone can say that a tile is far from where its stage was sent, but all of them together.
    """
    of_tile: dict[int, list[int]] = {}
    for number, pair in enumerate(pairs.tolist()):
        for tile in pair:
            of_tile.setdefault(tile, []).append(number)
    found: dict[int, FloatArray] = {}
    for tile, numbers in of_tile.items():
        if any(number in chosen or number in found for number in numbers):
            continue
        signs = [1.0 if pairs[number][1] == tile else -1.0 for number in numbers]
        moved = [s * (candidates[n].offsets - fitted.between(pairs[n])[0]) for s, n in zip(signs, numbers, strict=True)]
        moves = [_Move(n, k, nats) for n in numbers for k, nats in enumerate(candidates[n].nats.tolist())]
        place, agreeing = _largest_group(np.concatenate(moved), moves, search)
        if np.abs(place).max() <= search:
            continue
        margins = {move: move.nats - candidates[move.pair].best_besides(move.candidate) for move in agreeing}
        shown = {move: margin for move, margin in margins.items() if margin > 0.0}
        if len(shown) > 1 and sum(shown.values()) > _SURE - _MOVED:
            found |= {move.pair: candidates[move.pair].offsets[move.candidate] for move in shown}
    return found


def _largest_group(places: FloatArray, moves: Sequence[_Move], reach: float) -> tuple[FloatArray, list[_Move]]:
    """A move (2,) that pairs of a tile agree on the most, and the strongest candidate of each for it."""
    best, total, agreeing = np.zeros(2), -math.inf, list[_Move]()
    for place in places:
        strongest: dict[int, _Move] = {}
        for k in np.flatnonzero(np.abs(places - place).max(axis=1) <= reach).tolist():
            if moves[k].nats > strongest.get(moves[k].pair, (0, 0, -math.inf))[2]:
                strongest[moves[k].pair] = moves[k]
        if (together := sum(max(move.nats, 0.0) for move in strongest.values())) > total:
            best, total, agreeing = place, together, list(strongest.values())
    return best, agreeing


def _in_pairs(read: Callable[[int], _Tile], pairs: IntArray) -> Iterator[tuple[_Tile, _Tile]]:
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


def _transfer(overlap: Overlap, offset: FloatArray, camera: Camera) -> Transfer:
    """Map points of the first tile to the second, whose blocks are off by an offset in the mean."""
    if camera.distortion == 0.0:
        return lambda points: points - offset
    middle = overlap.centers
    between = (camera.undistort(middle) - camera.undistort(middle - offset)).mean(axis=0)
    return lambda points: camera.distort(camera.undistort(points) - between)


def _threshold(total: FloatArray, radius: int) -> float:
    """Height that a peak of noise hardly reaches within a window."""
    return peak_threshold(normal_std(total), (2 * radius + 1) ** 2)


def _coarse_links(pairs: IntArray, chosen: dict[int, FloatArray], plan: SearchPlan) -> LinkedPoints:
    """Matches of whole overlaps, as exact as coarse tiles show them."""
    matches = {}
    for number, offset in chosen.items():
        middle = (np.array(plan.grid.size) - 1.0 + offset) / 2.0
        information = np.eye(2)[None] / (plan.factor / 2.0) ** 2
        matches[number] = BlockMatches(middle[None], (middle - offset)[None], information)
    return LinkedPoints.of(pairs, matches)


def _result(plan: SearchPlan, pairs: IntArray, links: LinkedPoints, fitted: Adjustment) -> TileRegistration:
    grid = plan.grid
    held = links.tiles[fitted.weights[: len(links.tiles)] > _AGREES]
    joined = sparse.coo_matrix((np.ones(len(held)), held.T), shape=(len(grid),) * 2)
    count, label = csgraph.connected_components(joined, directed=False)
    groups = [np.flatnonzero(label == k) for k in range(count)]
    groups = sorted((group for group in groups if len(group) > 1), key=len, reverse=True)
    linked = np.isin(np.arange(len(grid)), held)
    return TileRegistration(grid, fitted, links, pairs, linked, tuple(tuple(g.tolist()) for g in groups), plan.search)
