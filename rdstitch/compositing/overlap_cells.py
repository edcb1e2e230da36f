"""What two images show of the same ground, as means of small cells: the measurements of gain compensation."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple, Self

import numpy as np

from rdstitch.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray, UInt8Array
from rdstitch.compositing.boxes import Box, cut
from rdstitch.compositing.photometric import full_scale
from rdstitch.compositing.survey import Survey, SurveyTile
from rdstitch.system.late_imports import sparse

_CELLS = 16  # along the longest side of an image or an overlap
_MAX_CELLS = 150_000  # of all overlaps together: of thousands, each needs fewer
_CLIPPED, _MOMENTS = 4, 5  # means of a cell after those of its samples: see _cells_of_overlap
_PAIRS_AT_A_TIME = 64  # that a thread compares: tens of milliseconds of work
_SAMPLES = 10  # pixels along each side of a cell that are looked at, at least, where it has so many
_DARKEST = 0.02  # share of the full range: below, integer samples are mostly noise
BRIGHTEST = 0.97  # share of the full range: above, integer samples are clipped
_PLAIN = 0.01  # deviation within a cell, share of the samples' median: below, a pattern is hardly more than noise
_PLAIN_COUNTS = 0.1  # what a cell without a pattern counts beside one with


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells that two images show."""

    pair: IntArray  # (M,): index of the overlap, ascending
    images: IntArray  # (2, M)
    points: FloatArray  # (2, M, 2): middle of the cell, measured pixels of either image
    values: FloatArray  # (2, M, C): mean samples, share of the full range
    clipped: BoolArray  # (2, M): where an image is burnt out, in all channels: its light is what they say, or more
    evidence: FloatArray  # (M,): from 0 to 1, how surely both images show the same there
    overlap: "sparse.csr_array"  # (N, N): what two images have in common, share of the smaller one

    @property
    def content(self) -> FloatArray:
        """Weight (M,) of what is the same once gains are known: then plain cells count as much as others."""
        return np.asarray((self.evidence / _PLAIN_COUNTS).clip(max=1.0))

    def darkened(self, errors: FloatArray) -> BoolArray:
        """Cells (M,) where what is burnt out is now darker than the same in the other image.

        A burnt-out sky is as bright as its samples or brighter, and must not end in a step either.
        """
        first = errors.mean(axis=1)
        return np.asarray((self.clipped & (np.stack([first, -first]) < 0.0)).any(axis=0))

    def by_image(self) -> Iterator[tuple[int, int, IntArray]]:
        """Side (0 or 1), image, and its cells."""
        return _by_image(self.images)


def _by_image(images: IntArray) -> Iterator[tuple[int, int, IntArray]]:
    """Side (0 or 1), image, and its places in ``images`` (2, M)."""
    for side, of_side in enumerate(images):
        order = np.argsort(of_side, kind="stable")
        for cells in np.split(order, np.flatnonzero(np.diff(of_side[order])) + 1):
            yield side, int(of_side[cells[0]]), cells


class _Shown(NamedTuple):
    """What is compared of an image."""

    tile: SurveyTile
    light: UInt8Array  # (h, w): see _light
    grey: Float32Array  # (h, w), share of the full range
    area: int  # pixels

    @classmethod
    def of(cls, tile: SurveyTile) -> Self:
        return cls(tile, _light(tile), _grey(tile.pixels), int(np.count_nonzero(tile.inside)))


def compare_overlaps(survey: Survey, workers: int = 1) -> Cells | None:
    """Compare all images that lie over each other, by so many threads; None where no two show the same."""
    pairs, count = survey.pairs(), len(survey.tiles)
    shown = {k: _Shown.of(tile) for k, tile in enumerate(survey.tiles) if tile is not None}
    overlap_fractions, cells = np.zeros(len(pairs)), list[tuple[IntArray, FloatArray, FloatArray]]()

    def compared(first: int) -> list[tuple[IntArray, FloatArray, FloatArray]]:
        of_pairs = []
        for index, (i, j) in enumerate(pairs[first : first + _PAIRS_AT_A_TIME].tolist(), start=first):
            box, seen = survey.overlap(i, j)
            overlap_fractions[index] = np.count_nonzero(seen) / min(shown[i].area, shown[j].area)
            for middles, means in _cells_of_overlap(shown[i], shown[j], box):
                every = max(1, -(-len(means) * len(pairs) // _MAX_CELLS))
                of_pairs.append((np.full(len(means[::every]), index), middles[::every], means[::every]))
        return of_pairs

    with ThreadPoolExecutor(workers) as pool:
        for of_pairs in pool.map(compared, range(0, len(pairs), _PAIRS_AT_A_TIME)):
            cells += of_pairs
    if not any(len(of_pair) for of_pair, _, _ in cells):
        return None
    pair, middles, means = (np.concatenate(each) for each in zip(*cells, strict=True))
    samples, clipped_fraction, moments = np.split(means, [-_CLIPPED - _MOMENTS, -_MOMENTS], axis=1)
    full = full_scale(next(iter(shown.values())).tile.pixels.dtype)
    values = np.moveaxis(samples.reshape(len(means), 2, -1), 1, 0) / full
    images, clipped, points = pairs[pair].T, clipped_fraction.T > 0.5, np.empty((2, len(pair), 2))
    evidence = _evidence(moments.T, np.asarray(clipped.any(axis=0)))
    for side, image, chosen in _by_image(images):
        points[side, chosen] = survey.warps[image].source_points(*middles[chosen].T)
    known = np.isfinite(points).all(axis=(0, 2))
    overlap = sparse.csr_array((overlap_fractions, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    parts = (images[:, known], points[:, known], values[:, known], clipped[2:, known], evidence[known])
    return Cells(pair[known], *parts, sparse.csr_array(overlap + overlap.T))


def _cells_of_overlap(a: _Shown, b: _Shown, box: Box) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Middles (M, 2), pixels of the survey, and means (M, K) of what no image clips, and then of what any clips.

    The means are of the samples of both images; of where any, and where all, of their channels are clipped, (M, 4); and
    of p, q, p², q² and p q of their grey values.
    """
    side = max(2, round(max(*a.tile.inside.shape, *b.tile.inside.shape) / _CELLS))
    step = max(1, side // _SAMPLES)
    compared: list[tuple[AnyArray, AnyArray]] = [
        (a.light, b.light),
        (a.grey, b.grey),
        (a.tile.pixels, b.tile.pixels),
    ]
    lit, (p, q), samples = (
        [cut(values, image.tile.box, box)[::step, ::step] for values, image in zip(both, (a, b), strict=True)]
        for both in compared
    )
    used = [which for which in (lit[0] * lit[1] == 1, lit[0] * lit[1] > 1) if which.any()]
    if used:
        clipped = [each > least for least in (1, 2) for each in lit]
        channels = [np.moveaxis(each, -1, 0) for each in samples]
        layers = np.concatenate([*channels, np.stack([*clipped, p, q, p * p, q * q, p * q])], dtype=np.float32)
    for which in used:
        middles, means = _cell_means(which, layers, side // step)
        yield step * middles + box[:2], means


def _evidence(moments: FloatArray, clipped: BoolArray) -> FloatArray:
    """How surely both images show the same in cells (M,), from the means of p, q, pp, qq and pq, shape (5, M).

    By the squared correlation of their patterns; where both are plain, or a sample is ``clipped``, they are taken to be
    alike, but count for less than any pattern.
    """
    p, q, pp, qq, pq = moments
    plain = (_PLAIN * float(np.median(moments[:2]))) ** 2
    first, second = (np.maximum(square - mean**2, 0.0) for square, mean in ((pp, p), (qq, q)))
    alike = ((pq - p * q + plain) / np.sqrt((first + plain) * (second + plain))).clip(0.0, 1.0) ** 2
    weaker = np.minimum(first, second)
    patterned = np.where(clipped, 0.0, weaker / (weaker + plain))
    return np.asarray(alike * (patterned + (1.0 - patterned) * _PLAIN_COUNTS))


def _grey(pixels: AnyArray) -> Float32Array:
    """Mean of the channels (h, w), share of the full range."""
    channels = pixels.shape[2]
    weights = np.full(channels, 1.0 / (channels * full_scale(pixels.dtype)), np.float32)
    return np.asarray(pixels @ weights, dtype=np.float32)


def _light(tile: SurveyTile) -> UInt8Array:
    """Which pixels (h, w) say how bright the scene is: 1; 2 where a channel is clipped, 4 where all are, 0 for none."""
    integer, full = tile.pixels.dtype.kind == "u", full_scale(tile.pixels.dtype)
    darkest, brightest = (_DARKEST * full, BRIGHTEST * full) if integer else (0.0, np.inf)
    low, high = (reduce(extreme, np.moveaxis(tile.pixels, -1, 0)) for extreme in (np.minimum, np.maximum))
    clipped = (high > brightest).astype(np.uint8) + (low > brightest)
    return np.asarray((tile.inside & (low > darkest)).astype(np.uint8) << clipped)


def _cell_means(which: BoolArray, layers: Float32Array, side: int) -> tuple[FloatArray, FloatArray]:
    """Mean x, y (M, 2), pixels of the box, and layers (K, h, w) of every cell of which more than half counts, (M, K).

    As products with matrices of ones and zeros, which are many times faster than sums along short axes.
    """
    rows, columns = (
        np.asarray(np.arange(n) // side == np.arange(-(-n // side))[:, None], np.float32) for n in which.shape
    )
    down, across = (cells * np.arange(cells.shape[1], dtype=np.float32) for cells in (rows, columns))
    weight = which.astype(np.float32)
    count, x, y = (a @ weight @ b.T for a, b in ((rows, columns), (rows, across), (down, columns)))
    used = count > side**2 / 2
    chosen = np.where(which, layers, np.float32(0.0)).reshape(-1, which.shape[1])
    sums = rows @ (chosen @ columns.T).reshape(len(layers), len(which), -1)
    divisor = count[used][:, None].astype(np.float64)
    return np.column_stack([x[used], y[used]]) / divisor, sums[:, used].T / divisor
