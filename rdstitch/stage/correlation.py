"""Phase correlation of the blocks of an expected overlap, whitened as far as they are more than noise."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.system.late_imports import fft

Image = NDArray[np.float32]

_TAPER = 0.15  # share of a window on each side over which it falls to 0
_NOISE_SHARE = 4.0  # products of spectra are whitened where they are so many times what noise would give
_CORRELATED = 4.0 * math.pi  # pixels that share their noise after a Gaussian filter of 1 pixel
_BETTER = 3.0  # standard deviations of chance by which a correlation must exceed another
_BLOCKS = 8  # blocks along a side of a tile: a lens that bends the overlap hardly bends one of them
# side of a block, pixels, from which on it has enough of independent pixels for its displacement to be sure
_LEAST_SIDE = 40


def _count(length: int, side: int) -> int:
    """Blocks along a length on a tile of a side."""
    return max(1, min(round(length / side * _BLOCKS), length // _LEAST_SIDE))


@dataclass(frozen=True)
class Overlap:
    """Two tiles and what they should have in common."""

    first: int
    second: int
    offset: IntArray  # (2,), int: expected place of the second in the first, pixels
    blocks: IntArray  # (K, 4), int: boxes x0, y0, x1, y1 in the first tile, end exclusive

    @classmethod
    def expected(cls, first: int, second: int, offset: FloatArray, size: tuple[int, int], least: int) -> "Overlap":
        """For tiles of a size, one of which should lie at an offset in the other.

        An overlap narrower than ``least`` pixels is taken to be so wide.
        """
        side = np.array(size)
        whole = np.rint(offset).astype(np.intp)
        low, high = np.maximum(0, whole), np.minimum(side, side + whole)
        lacking = np.maximum(0, least - (high - low))
        # Of the second tile so much is expected beyond the border of the first.
        low, high = low - np.where(whole > 0, lacking, 0), high + np.where(whole > 0, 0, lacking)
        along = int(np.argmax(high - low))
        count = _count(int((high - low)[along]), int(side[along]))
        edges = np.rint(np.linspace(low[along], high[along], count + 1)).astype(np.intp)
        blocks = np.empty((count, 4), dtype=np.intp)
        blocks[:, :2], blocks[:, 2:] = low, high
        blocks[:, along], blocks[:, 2 + along] = edges[:-1], edges[1:]
        return cls(first, second, whole, blocks)

    @property
    def whole(self) -> IntArray:
        """All blocks as one, (1, 4)."""
        return np.concatenate([self.blocks[:, :2].min(axis=0), self.blocks[:, 2:].max(axis=0)])[None]

    @property
    def centers(self) -> FloatArray:
        """Middle of each block in the first tile, pixels (K, 2)."""
        return np.asarray((self.blocks[:, :2] + self.blocks[:, 2:] - 1) / 2.0)

    def cells(self, size: tuple[int, int]) -> IntArray:
        """The blocks cut across too where the overlap is wide, (L, 4), and every other one then, as on a chessboard."""
        parts = []
        for row, (x0, y0, x1, y1) in enumerate(self.blocks.tolist()):
            across, down = (_count(b - a, n) for a, b, n in ((x0, x1, size[0]), (y0, y1, size[1])))
            x, y = np.rint(np.linspace(x0, x1, across + 1)), np.rint(np.linspace(y0, y1, down + 1))
            cut = [(i, k) for k in range(down) for i in range(across) if across * down == 1 or (i + k + row) % 2]
            parts += [(x[i], y[k], x[i + 1], y[k + 1]) for i, k in cut]
        return np.array(parts, dtype=np.intp)


@dataclass(frozen=True)
class Surfaces:
    """Correlation of each block over all displacements within a radius."""

    # (K, 2 P + 1, 2 P + 1), float16: rows are displacements in y, from -P on; columns in x. Noise has the standard
    # deviation 1 in their sum
    values: NDArray[np.float16]

    @property
    def reach(self) -> int:
        """P, pixels."""
        return int(self.values.shape[1] // 2)

    def total(self, shifts: FloatArray, radius: int) -> FloatArray:
        """Sum over the blocks, each displaced by its shift (K, 2) besides, (2 R + 1, 2 R + 1)."""
        total = np.zeros((2 * radius + 1, 2 * radius + 1), dtype=np.float32)
        for surface, (x, y) in zip(self.values, np.rint(shifts).astype(int).tolist(), strict=True):
            top, left = self.reach - radius + y, self.reach - radius + x
            if min(top, left) >= 0 and max(top, left) <= 2 * (self.reach - radius):
                total += surface[top : top + 2 * radius + 1, left : left + 2 * radius + 1]
        return total.astype(np.float64)


def correlate(first: Image, second: Image, overlap: Overlap, reach: int) -> Surfaces:
    """Correlate every block of two tiles (h, w) for displacements up to ``reach`` pixels.

    A displacement e at a block means that what the first tile shows at p is at ``p - offset - e`` in the second.
    """
    sizes = overlap.blocks[:, 2:] - overlap.blocks[:, :2] + 2 * reach
    shape = tuple(int(fft.next_fast_len(int(side), real=True)) for side in sizes.max(axis=0)[::-1])
    frames = np.zeros((2, len(sizes), *shape), dtype=np.float32)
    # A block is as long in the first tile as it is, and reaches as far as the search in the second; across, both do.
    along = int(np.argmax(np.ptp(overlap.blocks[:, :2], axis=0))) if len(sizes) > 1 else -1
    noise = np.zeros((2, len(sizes)))
    for number, block in enumerate(overlap.blocks):
        margins = np.full(2, reach)
        inner = margins.copy()
        if along >= 0:
            inner[along] = 0
        corner = block[:2] - reach
        noise[0, number] = _fill(frames[0, number], first, block, inner, corner)
        moved = block - np.tile(overlap.offset, 2)
        noise[1, number] = _fill(frames[1, number], second, moved, margins, corner - overlap.offset)
    spectra = fft.rfft2(frames)
    product = spectra[0] * np.conj(spectra[1])
    floor = np.float32(_NOISE_SHARE) * np.sqrt(noise[0] * noise[1]).astype(np.float32)
    product /= np.abs(product) + floor[:, None, None] + np.float32(1e-12)
    power = float((np.abs(product) ** 2).sum()) * 2.0
    surface = fft.irfft2(product, s=shape) * (shape[0] * shape[1] / np.sqrt(power + 1e-12))
    rows, columns = (np.arange(-reach, reach + 1) % side for side in shape)
    return Surfaces(surface[:, rows[:, None], columns].astype(np.float16))


def best_place(
    first: Image, second: Image, overlap: Overlap, shifts: FloatArray, places: Sequence[FloatArray]
) -> FloatArray:
    """Choose the place with the best normalized cross-correlation of what two tiles (h, w) have in common there.

    Places (2,) are those of the second tile in the first, pixels, and each block of the overlap is displaced by its
    shift (K, 2) besides. The first of the places stands unless another is better by more than chance.
    """
    if len(places) == 1:
        return places[0]
    one, two = (cv2.GaussianBlur(tile, (0, 0), 1.0) for tile in (first, second))
    scores, variances = np.full(len(places), -1.0), np.ones(len(places))
    for number, place in enumerate(places):
        common: tuple[list[NDArray[Any]], list[NDArray[Any]]] = [], []
        for block, moved in zip(overlap.blocks, np.rint(place + shifts).astype(int), strict=True):
            low = np.maximum(np.maximum(block[:2], moved), 0)
            high = np.maximum(low, np.minimum(np.minimum(block[2:], moved + second.shape[::-1]), first.shape[::-1]))
            for parts, tile, (x0, y0), (x1, y1) in (
                (common[0], one, low, high),
                (common[1], two, low - moved, high - moved),
            ):
                parts.append(tile[y0:y1, x0:x1].ravel())
        a, b = (np.concatenate(parts) for parts in common)
        if len(a):
            a, b = a - a.mean(), b - b.mean()
            scores[number] = float(a @ b) / max(math.sqrt(float(a @ a) * float(b @ b)), 1e-12)
            variances[number] = _CORRELATED / len(a)
    better = scores - _BETTER * np.sqrt(variances + variances[0]) > scores[0]
    return places[int(np.argmax(np.where(better, scores, -1.0)))] if better.any() else places[0]


def _fill(
    frame: Image, tile: Image, block: NDArray[np.intp], margin: NDArray[np.intp], corner: NDArray[np.intp]
) -> float:
    """Lay a block with a margin, as far as the tile has it, tapered into a frame; return its spectrum's noise power."""
    low = np.maximum(block[:2] - margin, 0)
    high = np.minimum(block[2:] + margin, tile.shape[::-1])
    if (high - low < 4).any():
        return 0.0
    part = tile[low[1] : high[1], low[0] : high[0]]
    weights = _taper(part.shape[0])[:, None] * _taper(part.shape[1])
    x, y = low - corner
    frame[y : y + part.shape[0], x : x + part.shape[1]] = (part - part.mean()) * weights
    return noise_variance(part) * float((weights**2).sum())


def noise_variance(part: Image) -> float:
    """Variance of white noise in an image, by second differences, which content hardly has; half of them count."""
    rows = part[::2]
    second = rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:]
    deviation = float(np.median(np.abs(second))) / 0.6745
    return deviation**2 / 6.0


@lru_cache(maxsize=64)
def _taper(length: int) -> Image:
    """A window that falls to 0 as a cosine at both ends."""
    distance = (np.minimum(np.arange(length), np.arange(length)[::-1]) + 0.5) / max(1.0, _TAPER * length)
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.minimum(distance, 1.0)), dtype=np.float32)
