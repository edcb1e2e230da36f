"""What overlapping images say of their light: means of the cells that two of them show."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.compositing.boxes import cut
from rdstitch.compositing.photometric import full_scale
from rdstitch.compositing.survey import Survey
from rdstitch.late_imports import sparse

# Along the longest side of an image or an overlap, and of all overlaps together: of thousands, each needs fewer.
_CELLS, _MAX_CELLS = 16, 150_000
_SAMPLES = 12  # along a side of a cell
# Integer samples outside this part of the range are clipped or mostly noise.
_DARKEST, _BRIGHTEST = 0.02, 0.97


@dataclass(frozen=True)
class Cells:
    """Cells that two images show.

    Attributes
    ----------
    pair : ndarray of shape (M,)
        Index of the overlap, ascending.
    images : ndarray of shape (2, M)
    points : ndarray of shape (2, M, 2)
        Middle of the cell, measured pixels of either image.
    values : ndarray of shape (2, M, C)
        Mean samples, share of the full range.
    clipped : ndarray of shape (2, M), bool
        Where an image is burnt out: its light is what the samples say, or more. Other cells hold no clipped sample.
    overlap : sparse array of shape (N, N)
        What two images have in common, share of the smaller one.
    """

    pair: IntArray
    images: IntArray
    points: FloatArray
    values: FloatArray
    clipped: BoolArray
    overlap: "sparse.csr_array"

    @property
    def clear(self) -> BoolArray:
        """Cells (M,) where neither image is burnt out."""
        return np.asarray(~self.clipped.any(axis=0))

    def by_image(self) -> Iterator[tuple[int, int, IntArray]]:
        """Side (0 or 1), image, and its cells."""
        for side, images in enumerate(self.images):
            order = np.argsort(images, kind="stable")
            for cells in np.split(order, np.flatnonzero(np.diff(images[order])) + 1):
                yield side, int(images[cells[0]]), cells


def compare_overlaps(survey: Survey) -> Cells | None:
    """Compare all images that lie over each other; None where no two show the same."""
    pairs, count = survey.pairs(), len(survey.tiles)
    areas = [0 if tile is None else np.count_nonzero(tile.inside) for tile in survey.tiles]
    shares, found = np.zeros(len(pairs)), []
    for index, (i, j) in enumerate(pairs.tolist()):
        a, b, box, seen = survey.overlap(i, j)
        shares[index] = np.count_nonzero(seen) / min(areas[i], areas[j])
        side = max(2, round(max(*seen.shape, *a.inside.shape, *b.inside.shape) / _CELLS))
        step = max(1, side // _SAMPLES)
        few = np.s_[::step, ::step]
        (va, bright_a), (vb, bright_b) = (_samples(cut(tile.pixels, tile.box, box)[few]) for tile in (a, b))
        lit = seen[few] & (np.minimum(va, vb) > (_DARKEST if a.pixels.dtype.kind == "u" else 0.0)).all(axis=0)
        layers = np.concatenate([va, vb, [bright_a, bright_b]])
        for which in filter(np.any, (lit & ~(bright_a | bright_b), lit & (bright_a | bright_b))):
            means = _cell_means(which, layers, side // step)
            means[:, :2] = means[:, :2] * step + box[:2]
            found.append((np.full(len(means), index), means))
    pair = np.concatenate([which for which, _ in found]) if found else np.zeros(0, dtype=np.intp)
    if not len(pair):
        return None
    kept = np.s_[:: -(-len(pair) // _MAX_CELLS)]
    pair, means = pair[kept], np.concatenate([means for _, means in found])[kept]
    values = np.moveaxis(means[:, 2:-2].reshape(len(means), 2, -1), 1, 0)
    overlap = sparse.csr_array((shares, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    clipped, points = means[:, -2:].T > 0.5, np.empty((2, len(pair), 2))
    cells = Cells(pair, pairs[pair].T, points, values, clipped, sparse.csr_array(overlap + overlap.T))
    for end, image, chosen in cells.by_image():
        points[end, chosen] = survey.warps[image].source_points(*means[chosen, :2].T)
    known = np.isfinite(points).all(axis=(0, 2))
    parts = (cells.images[:, known], points[:, known], values[:, known], clipped[:, known])
    return Cells(pair[known], *parts, cells.overlap)


def _samples(pixels: NDArray[Any]) -> tuple[FloatArray, BoolArray]:
    """Samples as share of the full range (C, h, w), and which pixels are clipped (h, w)."""
    values = np.ascontiguousarray(np.moveaxis(pixels, -1, 0)) / full_scale(pixels.dtype)
    return values, np.asarray((values > (_BRIGHTEST if pixels.dtype.kind == "u" else np.inf)).any(axis=0))


def _cell_means(which: BoolArray, values: FloatArray, side: int) -> FloatArray:
    """Mean x, y (pixels of the box) and values (K, h, w) of every cell of which more than half counts, (M, 2 + K).

    As products with matrices of ones and zeros, which are many times faster than sums along short axes.
    """
    weight = which.astype(np.float64)
    rows, columns = (1.0 * (np.arange(n) // side == np.arange(-(-n // side))[:, None]) for n in which.shape)
    down, across = (cells * np.arange(cells.shape[1]) for cells in (rows, columns))
    count, x, y = (a @ weight @ b.T for a, b in ((rows, columns), (rows, across), (down, columns)))
    sums = rows @ (values * weight) @ columns.T
    used = count > side**2 / 2
    means: FloatArray = np.column_stack([x[used], y[used], *sums[:, used]]) / count[used][:, None]
    return means
