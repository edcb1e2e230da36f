"""Phase correlation of the blocks of an expected overlap, whitened as far as they are more than noise."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.stage.coarse_tile import Image, noise_variance
from rdstitch.stage.overlap import Overlap
from rdstitch.system.late_imports import fft

_TAPER = 0.15  # share of a window on each side over which it falls to 0
_NOISE_SHARE = 4.0  # products of spectra are whitened where they are so many times what noise would give
_FALSE_ALARMS = 1e-4  # chance that the highest of all peaks of noise is taken for an overlap


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Correlation of each block over all displacements within a radius."""

    values: NDArray[np.float16]  # (K, 2 P + 1, 2 P + 1): rows are displacements in y, from -P on; columns in x
    plain: Image  # (2 P + 1, 2 P + 1): of all blocks; both as of :func:`correlate_frames`

    @property
    def reach(self) -> int:
        """P, pixels."""
        return int(self.values.shape[1] // 2)

    def total(self, shifts: FloatArray, radius: int) -> FloatArray:
        """Sum over the blocks, each displaced by its shift (K, 2) in addition, (2 R + 1, 2 R + 1)."""
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
        inner = np.where(np.arange(2) == along, 0, reach)
        corner = block[:2] - reach
        noise[0, number] = lay_tapered(frames[0, number], first, block, inner, corner)
        moved = block - np.tile(overlap.offset, 2)
        noise[1, number] = lay_tapered(frames[1, number], second, moved, margins, corner - overlap.offset)
    surfaces, plain = correlate_frames(frames, noise)
    rows, columns = (np.arange(-reach, reach + 1) % side for side in shape)
    return Surfaces(surfaces[:, rows[:, None], columns].astype(np.float16), plain[rows[:, None], columns])


def correlate_frames(frames: Image, noise: FloatArray) -> tuple[Image, Image]:
    """Correlate K pairs of frames (2, K, h, w) whose spectra have noise of so much power (2, K).

    First (K, h, w), with all frequencies as strong as they are sure: noise has the standard deviation 1 in the sum.
    Then (h, w), of all pairs, with the frequencies as strong as they are.
    """
    shape, spectra = frames.shape[2:], fft.rfft2(frames)
    product = spectra[0] * np.conj(spectra[1])
    plain = fft.irfft2(product.sum(axis=0), s=shape)
    of_noise = (_NOISE_SHARE * np.sqrt(noise.prod(axis=0))).astype(np.float32)[:, None, None]
    product /= np.abs(product) + of_noise + np.finfo(np.float32).tiny
    power = float((np.abs(product) ** 2).sum()) * 2.0
    return fft.irfft2(product, s=shape) * (shape[0] * shape[1] / np.sqrt(power + 1e-12)), plain


def peaks(surface: NDArray[Any], threshold: float, count: int) -> list[tuple[int, int]]:
    """Columns and rows of the highest peaks above a threshold, so many at most, the highest first."""
    rows, columns = np.nonzero((surface == cv2.dilate(surface, np.ones((3, 3), np.uint8))) & (surface > threshold))
    order = np.argsort(-surface[rows, columns], kind="stable")[:count]
    return list(zip(columns[order].tolist(), rows[order].tolist(), strict=True))


def peak_threshold(deviation: float, places: int) -> float:
    """Height that the highest of the peaks of noise of a standard deviation hardly reaches among so many places."""
    return deviation * math.sqrt(2.0 * math.log(places / _FALSE_ALARMS))


def lay_tapered(
    frame: Image, tile: Image, block: IntArray, margin: IntArray, corner: IntArray, fraction: float = _TAPER
) -> float:
    """Lay a block with a margin, as far as the tile has it, tapered into a frame; return its spectrum's noise power."""
    low = np.maximum(block[:2] - margin, 0)
    high = np.minimum(block[2:] + margin, tile.shape[::-1])
    if (high - low < 4).any():
        return 0.0
    part = tile[low[1] : high[1], low[0] : high[0]]
    weights = _taper(part.shape[0], fraction)[:, None] * _taper(part.shape[1], fraction)
    x, y = low - corner
    frame[y : y + part.shape[0], x : x + part.shape[1]] = (part - part.mean()) * weights
    return noise_variance(part) * float((weights**2).sum())


@lru_cache(maxsize=64)
def _taper(length: int, fraction: float) -> Image:
    """A window that falls to 0 as a cosine at both ends, over a share of its length."""
    distance = (np.minimum(np.arange(length), np.arange(length)[::-1]) + 0.5) / max(1.0, fraction * length)
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.minimum(distance, 1.0)), dtype=np.float32)
