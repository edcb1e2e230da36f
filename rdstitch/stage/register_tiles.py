"""From nominal places and tiles to all places: correlate, learn the stage, refine, adjust."""

import csv
import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.camera import Camera
from rdstitch.robust.loss import NORMAL_MEDIAN
from rdstitch.stage.adjustment import Adjustment, LinkedPoints, adjust
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
from rdstitch.stage.refinement import BlockMatches, Transfer, refine
from rdstitch.system.late_imports import csgraph, sparse
from rdstitch.system.progress import Progress, silent

Reader = Callable[[int], NDArray[Any]]
"""Gives a tile as it is registered, (h, w)."""

_Tile = TypeVar("_Tile")

COARSE_SIDE = 512  # pixels of the longer side of a tile that are enough to find a displacement to a pixel of theirs
# displacement from the nominal place that is searched where the user does not say, share of the longer side
_SEARCH = 0.05
# largest displacement of an overlap's blocks against each other that the lens may add, share of the longer side
_LENS_REACH = 0.02
_LENSES = np.linspace(-0.04, 0.04, 21)  # values of λ that are tried before it is estimated
_NARROW = 2  # pixels about where others say that a pair is: peaks are kept that rise above the noise of so few
_CANDIDATES = 8  # highest peaks of a pair that are compared by normalized cross-correlation
_AGREES = 0.25  # weight of a pair from which on it holds its tiles
_LEAST_BLOCK = 0.02  # overlap that is compared at least, share of the longer side
_POOR = 6.0  # nats below which a pair is looked for elsewhere: a correlation of about 0.6
_RIVAL = 4.6  # nats from which on a place is possible that the whitened correlation does not show: a hundred to one
_SHOWS = 0.5  # share of the variance of a tile that must be content to look for it elsewhere
_SURE = 0.99  # probability that one place of a pair must have among all that are possible
_ASTRAY = 1e-3  # probability that a tile is anywhere but where its stage was sent, within its errors
_LARGEST_STD = 1.0  # coarse pixels
_ROUNDS = 4  # by which what is certain of the stage decides about what was not
# λ is taken where pairs along rows and pairs along columns show it by so many standard deviations each
_LENS_SHOWN = 5.0
_LENS_AGREES = 0.25  # and where the two differ by no more than so much of it, beyond chance
_WHOLE_PIXEL = 0.5  # and where corners move farther than by leaving whole pixels


@dataclass(frozen=True)
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


def search_radius(grid: TileGrid, search: float | None) -> float:
    """How far neighbours may be off, pixels."""
    return _SEARCH * max(grid.size) if search is None else search


def coarse_factor(grid: TileGrid) -> int:
    """By how much tiles are made smaller to be looked for."""
    return max(1, round(max(grid.size) / COARSE_SIDE))


def register_tiles(
    grid: TileGrid,
    read: Reader,
    *,
    search: float | None = None,
    distortion: float | Literal["auto"] | None = None,
    progress: Progress = silent,
) -> TileRegistration:
    """Find the places of all tiles; ``search`` is how far neighbours may be off, pixels.

    ``distortion`` is λ where it is known, "auto" where it is to be estimated; otherwise it is 0 unless pairs along rows
    and pairs along columns show the same.
    """
    search, factor = search_radius(grid, search), coarse_factor(grid)
    pairs = grid.neighbours(search)
    known = distortion if isinstance(distortion, float | int) else None
    finder = _PairFinder(grid, pairs, factor, search)
    candidates, lens = finder.candidates(read, known, progress)
    chosen, rough = _chosen(grid, pairs, candidates, factor, search, lens)
    if not chosen:
        return _result(grid, pairs, _links(pairs, {}), rough, search)
    matches: dict[int, BlockMatches] = {}
    camera = Camera(grid.size, lens)
    numbers = sorted(chosen)
    for count, (one, two) in enumerate(_in_pairs(read, pairs[numbers])):
        number = numbers[count]
        offset = chosen[number]
        overlap = finder.overlap(number, offset, 1)
        for cells in (overlap.cells(grid.size), overlap.whole):
            cut = replace(overlap, blocks=cells)
            refined = refine(one, two, cells, _transfer(cut, offset, camera), factor + 1.5)
            # What is less sure than the coarse place was not found by looking around that.
            if refined.std < _LARGEST_STD * factor:
                matches[number] = refined
                break
        progress("refining", count + 1, len(chosen))
    links = _links(pairs, matches)
    return _result(grid, pairs, links, _with_lens(grid, links, search / 3.0, lens, distortion), search)


def _with_lens(
    grid: TileGrid, links: LinkedPoints, std: float, lens: float, wanted: float | Literal["auto"] | None
) -> Adjustment:
    """All places, with λ where it is asked for, or where it is there."""
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


@dataclass(frozen=True)
class _Candidates:
    """Where the second tile of a pair may be in the first."""

    offsets: FloatArray  # (K, 2), pixels
    nats: FloatArray  # (K,): evidence for each, see :func:`log_evidence`
    grain: float  # pixels within which two of them are one


class _PairFinder:
    """Looks for the second tile of each pair in the first, on coarse tiles."""

    def __init__(self, grid: TileGrid, pairs: IntArray, factor: int, search: float) -> None:
        self.grid, self.pairs, self.factor = grid, pairs, factor
        side = max(grid.size)
        self.radius = max(2, math.ceil(search / factor))
        self.spare = math.ceil(_LENS_REACH * side / factor)
        self.least = math.ceil(_LEAST_BLOCK * side)
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
        if max(nats, default=0.0) < _POOR and min(tile.content_share for tile in tiles) > _SHOWS:
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
    grid: TileGrid, pairs: IntArray, candidates: Sequence[_Candidates], factor: int, search: float, lens: float
) -> tuple[dict[int, FloatArray], Adjustment]:
    """Where the second tile of a pair is in the first, by pair, where one place stands out; and all places by that.

    What is certain teaches what the stage does, and that decides among the places of the other pairs.
    """
    chosen: dict[int, FloatArray] = {}
    std = search / 3.0
    fitted = adjust(grid, _links(pairs, {}), std, lens)
    outside = math.log(float(np.prod(grid.size)))
    for count in range(_ROUNDS):
        before = dict(chosen)
        doubted = {number for number, weight in zip(chosen, fitted.weights, strict=True) if weight < _AGREES}
        for number, of_pair in enumerate(candidates):
            if not len(of_pair.nats) or (number in chosen and number not in doubted):
                continue
            expected, covariance = fitted.between(pairs[number])
            covariance = covariance + np.eye(2) * (factor / 2.0) ** 2
            off = of_pair.offsets - expected
            log_prior = -0.5 * np.einsum("ki,ij,kj->k", off, np.linalg.inv(covariance), off) - 0.5 * math.log(
                (2.0 * math.pi) ** 2 * float(np.linalg.det(covariance))
            )
            score = of_pair.nats + np.logaddexp(log_prior, math.log(_ASTRAY) - outside)
            best = int(score.argmax())
            # Nothing of what was found may be right, either.
            apart = np.abs(of_pair.offsets - of_pair.offsets[best]).max(axis=1) > of_pair.grain
            others = np.append(score[apart], -outside)
            chosen.pop(number, None)
            sure = score[best] - np.logaddexp.reduce(others) > math.log(_SURE / (1.0 - _SURE))
            # What is likely wherever the stage is goes first, and what is so only near where it should be second.
            if sure and (count > 0 or of_pair.nats[best] > _RIVAL):
                chosen[number] = of_pair.offsets[best]
        chosen.update(_moved_tiles(pairs, candidates, fitted, chosen, search))
        chosen = dict(sorted(chosen.items()))
        if count > 0 and {k: v.tolist() for k, v in chosen.items()} == {k: v.tolist() for k, v in before.items()}:
            break
        fitted = adjust(grid, _coarse_links(grid, pairs, chosen, factor), std, lens)
    return chosen, fitted


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
        moves, nats = list[FloatArray](), list[FloatArray]()
        owner, index = list[int](), list[int]()
        for number in numbers:
            expected, _ = fitted.between(pairs[number])
            sign = 1.0 if pairs[number][1] == tile else -1.0
            moves.append(sign * (candidates[number].offsets - expected))
            nats.append(candidates[number].nats)
            owner += [number] * len(candidates[number].nats)
            index += range(len(candidates[number].nats))
        move, value, pair = np.concatenate(moves), np.concatenate(nats), np.array(owner, dtype=np.intp)
        near = np.abs(move[:, None] - move).max(axis=2) <= search
        together = [sum(value[row & (pair == n)].max(initial=0.0) for n in set(owner)) for row in near]
        best = int(np.argmax(together)) if together else -1
        if best < 0 or np.abs(move[best]).max() <= search:
            continue
        margins: dict[int, tuple[float, int]] = {}
        for number in {owner[k] for k in np.flatnonzero(near[best])}:
            own = candidates[number]
            k = index[max(np.flatnonzero(near[best] & (pair == number)), key=value.__getitem__)]
            apart = np.abs(own.offsets - own.offsets[k]).max(axis=1) > own.grain
            margins[number] = own.nats[k] - own.nats[apart].max(initial=0.0), k
        shown = {number: k for number, (margin, k) in margins.items() if margin > 0.0}
        if len(shown) > 1 and sum(margins[n][0] for n in shown) > math.log(_SURE / (1.0 - _SURE) / _ASTRAY):
            found |= {number: candidates[number].offsets[k] for number, k in shown.items()}
    return found


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
    deviation = float(np.median(np.abs(total))) / NORMAL_MEDIAN
    return peak_threshold(deviation, (2 * radius + 1) ** 2)


def _coarse_links(grid: TileGrid, pairs: IntArray, chosen: dict[int, FloatArray], factor: int) -> LinkedPoints:
    """Matches of whole overlaps, as exact as coarse tiles show them."""
    matches = {}
    for number, offset in chosen.items():
        middle = (np.array(grid.size) - 1.0 + offset) / 2.0
        information = np.eye(2)[None] / (factor / 2.0) ** 2
        matches[number] = BlockMatches(middle[None], (middle - offset)[None], information)
    return _links(pairs, matches)


def _links(pairs: IntArray, matches: dict[int, BlockMatches]) -> LinkedPoints:
    """Concatenate the matches of all pairs."""
    blocks = [BlockMatches.none(), *matches.values()]
    return LinkedPoints(
        np.repeat(np.arange(-1, len(matches)), [len(match) for match in blocks]),
        pairs[list(matches)],
        np.concatenate([match.points1 for match in blocks]),
        np.concatenate([match.points2 for match in blocks]),
        np.concatenate([match.information for match in blocks]),
    )


def _result(
    grid: TileGrid, pairs: IntArray, links: LinkedPoints, fitted: Adjustment, search: float
) -> TileRegistration:
    held = links.tiles[fitted.weights[: len(links.tiles)] > _AGREES]
    joined = sparse.coo_matrix((np.ones(len(held)), held.T), shape=(len(grid),) * 2)
    count, label = csgraph.connected_components(joined, directed=False)
    groups = [np.flatnonzero(label == k) for k in range(count)]
    groups = sorted((group for group in groups if len(group) > 1), key=len, reverse=True)
    linked = np.isin(np.arange(len(grid)), held)
    return TileRegistration(grid, fitted, links, pairs, linked, tuple(tuple(g.tolist()) for g in groups), search)


def places_table(names: Sequence[str], tiled: TileRegistration) -> str:
    """CSV of name, x and y of the first pixel, row, column, what placed it, and micrometres where they are known."""
    grid, places = tiled.grid, tiled.adjustment.places
    places = places - places.min(axis=0)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    micrometres = [] if grid.pixel_size is None else ["x_um", "y_um"]
    table.writerow(["name", "x", "y", "std", "row", "column", "placed_by", *micrometres])
    rows, columns = grid.rows, grid.columns
    for k, (name, place, std) in enumerate(zip(names, places.tolist(), tiled.stds, strict=True)):
        line = [name, *(f"{value:.3f}" for value in (*place, std)), rows[k], columns[k]]
        by = "overlap" if tiled.linked[k] else "stage"
        table.writerow([*line, by, *(f"{value * grid.pixel_size:.4f}" for value in place if grid.pixel_size)])
    return text.getvalue()
