"""From nominal places and tiles to all places: correlate, learn the stage, refine, adjust."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.camera import Camera
from rdstitch.io.reduction import block_mean
from rdstitch.stage.adjustment import Adjustment, LinkedPoints, adjust
from rdstitch.stage.correlation import Overlap, Surfaces, best_place, correlate
from rdstitch.stage.grid import TileGrid
from rdstitch.stage.refinement import BlockMatches, Transfer, refine
from rdstitch.system.late_imports import csgraph, sparse
from rdstitch.system.progress import Progress, silent

Reader = Callable[[int], NDArray[Any]]
"""Gives a tile as it is registered, (h, w)."""

_COARSE_SIDE = 512  # pixels of the longer side of a tile that are enough to find a displacement to a pixel of theirs
# displacement from the nominal place that is searched where the user does not say, share of the longer side
_SEARCH = 0.05
# largest displacement of an overlap's blocks against each other that the lens may add, share of the longer side
_LENS_REACH = 0.02
_LENSES = np.linspace(-0.04, 0.04, 21)  # values of λ that are tried before it is estimated
_FALSE_ALARMS = 1e-4  # chance that the highest of all peaks of noise is taken for an overlap
_LARGEST_REACH = 4.0  # standard deviations of the stage within which a peak of little height is looked for
_CANDIDATES = 12  # highest peaks of a pair that are compared by normalized cross-correlation
_AGREES = 0.25  # weight of a pair from which on it holds its tiles
_PROBED = 16  # pairs by which the axes of the stage are found
_LEAST_BLOCK = 0.02  # overlap that is compared at least, share of the longer side


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


def register_tiles(
    grid: TileGrid,
    read: Reader,
    *,
    search: float | None = None,
    distortion: float | None = None,
    progress: Progress = silent,
) -> TileRegistration:
    """Find the places of all tiles; ``search`` is how far neighbours may be off, pixels."""
    side = max(grid.size)
    search = _SEARCH * side if search is None else search
    pairs = grid.neighbours(search)
    factor = max(1, round(side / _COARSE_SIDE))
    radius, spare = max(2, math.ceil(search / factor)), math.ceil(_LENS_REACH * side / factor)
    least = math.ceil(_LEAST_BLOCK * side)

    def expected(pair: IntArray, places: FloatArray, scale: int) -> Overlap:
        size = -(-grid.size[0] // scale), -(-grid.size[1] // scale)
        first, second = pair.tolist()
        return Overlap.expected(first, second, (places[second] - places[first]) / scale, size, least // scale)

    overlaps = [expected(pair, grid.places, factor) for pair in pairs]
    surfaces: list[Surfaces] = []
    for number, (one, two) in enumerate(_in_pairs(lambda k: _coarse(read(k), factor), pairs)):
        surfaces.append(correlate(one, two, overlaps[number], radius + spare))
        progress("correlating", number + 1, len(pairs))
    coarse = Camera((-(-grid.size[0] // factor), -(-grid.size[1] // factor)))
    known = _best_lens(surfaces, overlaps, coarse, radius) if distortion is None else distortion
    lens, coarse = Camera(grid.size, known), coarse.with_coefficients(known)
    peaks = [_peaks(s, o, _shifts(o, coarse), radius) for s, o in zip(surfaces, overlaps, strict=True)]
    rough = _adjusted(grid, pairs, peaks, factor, search, known)
    # Again, nearer to where the stage as it has shown itself puts them.
    near = rough.places
    std = max(rough.stage.std, factor / 2.0)
    window = max(2, min(radius, math.ceil(_LARGEST_REACH * math.sqrt(2.0) * std / factor)))
    peaks = [
        _peaks(s, o, _shifts(o, coarse), radius, ((near[p[1]] - near[p[0]]) / factor - o.offset, window)) + others
        for s, o, p, others in zip(surfaces, overlaps, pairs, peaks, strict=True)
    ]
    peaks = [list({tuple(peak): peak for peak in of_pair}.values()) for of_pair in peaks]
    shown = [k for k, of_pair in enumerate(peaks) if of_pair]
    if not shown:
        return _result(grid, pairs, [], rough)
    matches: dict[int, BlockMatches] = {}
    for number, (one, two) in enumerate(_in_pairs(read, pairs[shown])):
        pair, overlap = pairs[shown[number]], overlaps[shown[number]]
        # Whitened spectra weigh all frequencies alike: of a repeated pattern a wrong period may be the highest peak.
        small = _coarse(one, factor), _coarse(two, factor)
        offset = factor * best_place(*small, overlap, _shifts(overlap, coarse), peaks[shown[number]])
        overlap = expected(pair, _moved(grid.places, pair, offset), 1)
        for cells in (overlap.cells(grid.size), overlap.whole):
            cut = replace(overlap, blocks=cells)
            refined = refine(one, two, cells, _transfer(cut, offset, lens), factor + 1.5)
            if len(refined):
                matches[shown[number]] = refined
                break
        progress("refining", number + 1, len(shown))
    if not matches:
        return _result(grid, pairs, [], rough)
    links = _links(pairs, matches)
    std = search / 3.0
    fitted = adjust(grid, links, std, 0.0 if distortion is None else distortion)
    if distortion is None:
        bent = adjust(grid, links, std, known, free_lens=True)
        if fitted.cost(bent.noise) - bent.cost(bent.noise) > math.log(max(2, len(links.pair))):
            fitted = bent
        else:
            fitted = replace(fitted, distortion_std=bent.distortion_std)
    return _result(grid, pairs, links, fitted)


def evidence(grid: TileGrid, *, read: Reader, search: float | None = None) -> float:
    """Measure how clearly some neighbours correlate where the grid has them, in heights of peaks above noise."""
    side = max(grid.size)
    search = _SEARCH * side if search is None else search
    pairs = grid.neighbours(search)
    if not len(pairs):
        return 0.0
    pairs = pairs[np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), _PROBED)).astype(np.intp))]
    factor = max(1, round(side / _COARSE_SIDE))
    radius = max(2, math.ceil(search / factor))
    size = -(-grid.size[0] // factor), -(-grid.size[1] // factor)
    shown = 0.0
    for pair, (one, two) in zip(pairs, _in_pairs(lambda k: _coarse(read(k), factor), pairs), strict=True):
        offset = (grid.places[pair[1]] - grid.places[pair[0]]) / factor
        overlap = Overlap.expected(int(pair[0]), int(pair[1]), offset, size, math.ceil(_LEAST_BLOCK * max(size)))
        total = correlate(one, two, overlap, radius).total(np.zeros((len(overlap.blocks), 2)), radius)
        shown += max(0.0, float(total.max()) - _threshold(total, radius))
    return shown


def _coarse(tile: NDArray[Any], factor: int) -> NDArray[np.float32]:
    return np.asarray(block_mean(tile, factor), dtype=np.float32)


def _in_pairs(read: Reader, pairs: IntArray) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
    """The tiles of each pair; each is read when it is first needed, and kept until its last pair has been."""
    last = {int(tile): number for number, pair in enumerate(pairs) for tile in pair}
    held: dict[int, NDArray[Any]] = {}
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


def _best_lens(surfaces: Sequence[Surfaces], overlaps: Sequence[Overlap], camera: Camera, radius: int) -> float:
    """λ for which the blocks of all pairs agree best."""
    heights = np.zeros(len(_LENSES))
    lenses = [camera.with_coefficients(value) for value in _LENSES]
    for surface, overlap in zip(surfaces, overlaps, strict=True):
        tops = np.array([surface.total(_shifts(overlap, lens), radius).max() for lens in lenses])
        if tops.max() > _threshold(surface.total(np.zeros((len(overlap.blocks), 2)), radius), radius):
            heights += tops
    return 0.0 if heights.max() <= heights[len(_LENSES) // 2] else float(_LENSES[int(heights.argmax())])


def _threshold(total: FloatArray, radius: int) -> float:
    """Height that a peak of noise hardly reaches within a window."""
    deviation = float(np.median(np.abs(total))) / 0.6745
    return deviation * math.sqrt(2.0 * math.log((2 * radius + 1) ** 2 / _FALSE_ALARMS))


def _peaks(
    surface: Surfaces,
    overlap: Overlap,
    shifts: FloatArray,
    radius: int,
    near: tuple[FloatArray, int] | None = None,
) -> list[FloatArray]:
    """Places of the second tile in the first, coarse pixels, at peaks of which the first, the highest, is no noise.

    Near an expected displacement, if that is given with a window.
    """
    total = surface.total(shifts, radius)
    middle, window = (np.zeros(2), radius) if near is None else near
    low = np.clip(np.rint(middle).astype(int) - window + radius, 0, 2 * radius)
    high = np.clip(np.rint(middle).astype(int) + window + radius + 1, 1, 2 * radius + 1)
    part = total[low[1] : high[1], low[0] : high[0]]
    if part.max() < _threshold(total, window):
        return []
    y, x = np.nonzero(part == cv2.dilate(part, np.ones((3, 3), dtype=np.uint8)))
    order = np.argsort(-part[y, x], kind="stable")[:_CANDIDATES]
    return [overlap.offset + low + (x[k], y[k]) - radius for k in order]


def _moved(places: FloatArray, pair: IntArray, offset: FloatArray) -> FloatArray:
    """The places with the second tile of a pair at an offset in the first."""
    moved = places.copy()
    moved[pair[1]] = moved[pair[0]] + offset
    return moved


def _adjusted(
    grid: TileGrid,
    pairs: IntArray,
    peaks: Sequence[Sequence[FloatArray]],
    factor: int,
    search: float,
    distortion: float,
) -> Adjustment:
    """Places by the highest peaks alone."""
    matches = {}
    for number, highest in enumerate(peaks):
        if highest:
            offset = highest[0] * factor
            middle = (np.array(grid.size) - 1.0 + offset) / 2.0
            information = np.eye(2)[None] / (factor / 2.0) ** 2
            matches[number] = BlockMatches(middle[None], (middle - offset)[None], information)
    return adjust(grid, _links(pairs, matches), search / 3.0, distortion)


def _links(pairs: IntArray, matches: dict[int, BlockMatches]) -> LinkedPoints:
    """Concatenate the matches of all pairs."""
    blocks = list(matches.values())
    if not blocks:
        return LinkedPoints(
            np.empty(0, np.intp), np.empty((0, 2), np.intp), np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2, 2))
        )
    return LinkedPoints(
        np.repeat(np.arange(len(blocks)), [len(match) for match in blocks]),
        pairs[list(matches)],
        np.concatenate([match.points1 for match in blocks]),
        np.concatenate([match.points2 for match in blocks]),
        np.concatenate([match.information for match in blocks]),
    )


def _result(grid: TileGrid, pairs: IntArray, links: Any, fitted: Adjustment) -> TileRegistration:
    links = links or _links(pairs, {})
    held = links.tiles[fitted.weights[: len(links.tiles)] > _AGREES]
    joined = sparse.coo_matrix((np.ones(len(held)), held.T), shape=(len(grid),) * 2)
    count, label = csgraph.connected_components(joined, directed=False)
    groups = [np.flatnonzero(label == k) for k in range(count)]
    groups = sorted((group for group in groups if len(group) > 1), key=len, reverse=True)
    linked = np.isin(np.arange(len(grid)), held)
    return TileRegistration(grid, fitted, links, pairs, linked, tuple(tuple(g.tolist()) for g in groups))


def places_table(names: Sequence[str], tiled: TileRegistration) -> str:
    """CSV of name, x and y of the first pixel, row, column, what placed it, and micrometres where they are known."""
    grid, fitted = tiled.grid, tiled.adjustment
    places = fitted.places - fitted.places.min(axis=0)
    header = ["name", "x", "y", "row", "column", "placed_by"]
    if grid.pixel_size is not None:
        header += ["x_um", "y_um"]
    lines = [",".join(header)]
    for index, name in enumerate(names):
        x, y = places[index].tolist()
        by = "overlap" if tiled.linked[index] else "stage"
        quoted = f'"{name}"' if "," in name else name
        cells = [quoted, f"{x:.3f}", f"{y:.3f}", str(grid.rows[index]), str(grid.columns[index]), by]
        if grid.pixel_size is not None:
            cells += [f"{x * grid.pixel_size:.4f}", f"{y * grid.pixel_size:.4f}"]
        lines.append(",".join(cells))
    return "\n".join([*lines, ""])
