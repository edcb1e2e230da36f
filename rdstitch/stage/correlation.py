"""Phase correlation of the blocks of an expected overlap, whitened as far as they are more than noise."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.io.reduction import block_mean
from rdstitch.robust.loss import normal_std
from rdstitch.system.dataclasses import dataclass
from rdstitch.system.late_imports import fft

Image = NDArray[np.float32]

_TAPER = 0.15  # share of a window on each side over which it falls to 0
_NOISE_SHARE = 4.0  # products of spectra are whitened where they are so many times what noise would give
_CORRELATED = 4.0 * math.pi  # pixels that share their noise after a Gaussian filter of 1 pixel
_FALSE_ALARMS = 1e-4  # chance that the highest of all peaks of noise is taken for an overlap
_ILLUMINATION = 0.25  # share of a tile's side over which its illumination, or the medium's glow, is even
_UNLIKE = 0.2  # share of the variance that two images of the same may differ by: interpolation, bleaching, focus
_INDEPENDENT = 24  # independent pieces of evidence that the pixels of an overlap count for
_CONTENT = 0.02  # least share of the variance that is content: the noise is not known better
_WIDE_PEAKS = 6  # highest peaks of two whole tiles that are compared by their normalized cross-correlation
_EDGE = 0.02  # the taper of whole tiles, whose overlap is at their border
_MIN_STEP = 0.35  # displacement of neighbours along one of the axes, at least, share of the side
_MIN_COMMON = 0.02  # share of the side that neighbours have in common, at least
_BLOCKS = 8  # blocks along a side of a tile: a lens that bends the overlap hardly bends one of them
# side of a block, pixels, from which on it has enough of independent pixels for its displacement to be sure
_MIN_BLOCK_SIDE = 40


def _count(length: int, side: int) -> int:
    """Blocks along a length on a tile of a side."""
    return max(1, min(round(length / side * _BLOCKS), length // _MIN_BLOCK_SIDE))


@dataclass(frozen=True, eq=False)
class Overlap:
    """Two tiles and what they should have in common."""

    first: int
    second: int
    offset: IntArray  # (2,), int: expected place of the second in the first, pixels
    blocks: IntArray  # (K, 4), int: boxes x0, y0, x1, y1 in the first tile, end exclusive

    @classmethod
    def expected(cls, first: int, second: int, offset: FloatArray, sizes: IntArray, least: int) -> "Overlap":
        """For two tiles of sizes (2, 2), width and height, the second of which should lie at an offset in the first.

        An overlap narrower than ``least`` pixels is taken to be so wide.
        """
        side = sizes[0]
        whole = np.rint(offset).astype(np.intp)
        low, high = np.maximum(0, whole), np.minimum(side, sizes[1] + whole)
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


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Correlation of each block over all displacements within a radius."""

    # (K, 2 P + 1, 2 P + 1), float16: rows are displacements in y, from -P on; columns in x. Noise has the standard
    # deviation 1 in their sum
    values: NDArray[np.float16]
    plain: Image  # (2 P + 1, 2 P + 1): of all blocks, with the frequencies as strong as they are

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
    rows, columns = (np.arange(-reach, reach + 1) % side for side in shape)
    plain = fft.irfft2(product.sum(axis=0), s=shape)[rows[:, None], columns]
    _whiten(product, noise[0][:, None, None], noise[1][:, None, None])
    power = float((np.abs(product) ** 2).sum()) * 2.0
    surface = fft.irfft2(product, s=shape) * (shape[0] * shape[1] / np.sqrt(power + 1e-12))
    return Surfaces(surface[:, rows[:, None], columns].astype(np.float16), plain)


def _whiten(product: NDArray[np.complexfloating], noise1: FloatArray, noise2: FloatArray) -> None:
    """Make all frequencies of a product of spectra as strong as they are sure, by the noise power of both."""
    product /= np.abs(product) + (_NOISE_SHARE * np.sqrt(noise1 * noise2)).astype(np.float32) + np.float32(1e-12)


@dataclass(frozen=True, eq=False)
class CoarseTile:
    """A tile as overlaps are looked for."""

    pixels: Image  # (h, w)
    content: Image  # (h, w): without most of its noise, without the illumination, and less bright where it is bright
    noise: float  # variance of the noise of a pixel in units of the content

    @property
    def content_share(self) -> float:
        """Share of the variance of the content that is none of noise."""
        return 1.0 - self.noise / _CORRELATED / max(float(self.content.var()), 1e-12)

    @property
    def grain(self) -> float:
        """Radius of the area that is alike, pixels: peaks that are no farther from each other are one."""
        squares, slopes = float(np.vdot(self.content, self.content)), _energies(self.content)[1]
        return max(2.0, math.sqrt(2.0 * squares / max(slopes, 1e-30)))


def coarse_tile(tile: NDArray[Any], factor: int) -> CoarseTile:
    """Blocks of so many pixels a side of a tile (h, w) become one."""
    image = np.asarray(block_mean(tile, factor), dtype=np.float32)
    noise = noise_variance(image)
    side = max(3, round(_ILLUMINATION * max(image.shape)) | 1)
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    light = smooth - np.float32(np.median(smooth))
    # The brightest spot must not be all that counts.
    scale = max(4.0 * math.sqrt(noise / _CORRELATED), 1.5 * float(np.median(np.abs(light))), 0.1 * float(light.std()))
    light = np.arcsinh(light / np.float32(max(scale, 1e-12)))
    even = cv2.blur(light, (side, side), borderType=cv2.BORDER_REFLECT)
    return CoarseTile(image, np.asarray(light - even, dtype=np.float32), noise / max(scale, 1e-12) ** 2)


def log_evidence(
    tiles: Sequence[CoarseTile], overlap: Overlap, place: FloatArray, shifts: FloatArray | None = None
) -> float:
    """How much more likely two tiles are with the second at a place (2,) in the first than anywhere else, in nats.

    By their normalized cross-correlation in the blocks of the overlap, each displaced by its shift (K, 2) besides, but
    for their noise. However many pixels an overlap has, they count as few: neighbours are alike, and what interpolation
    and bleaching change is not independent.
    """
    first, second = (tile.content for tile in tiles)
    noise = np.array([tile.noise for tile in tiles])
    shifts = np.zeros((len(overlap.blocks), 2)) if shifts is None else shifts
    products, pixels, features = np.zeros(3), 0, np.zeros(2)
    for block, moved in zip(overlap.blocks, place + shifts, strict=True):
        low = np.maximum(np.maximum(block[:2], np.ceil(moved).astype(np.intp)), 0)
        high = np.minimum(
            np.minimum(block[2:], np.floor(moved).astype(np.intp) + second.shape[::-1]), first.shape[::-1]
        )
        width, height = (high - low).tolist()
        if min(width, height) < 2:
            continue
        x, y = (low - moved).tolist()
        a = first[low[1] : high[1], low[0] : high[0]]
        middle = x + (width - 1) / 2.0, y + (height - 1) / 2.0
        b = np.asarray(cv2.getRectSubPix(second, (width, height), middle), dtype=np.float32)
        products += [float(np.vdot(a, a)), float(np.vdot(b, b)), float(np.vdot(a, b))]
        features += _energies(a)
        pixels += width * height
    if pixels < _CORRELATED or not min(products[:2]) > 0.0:
        return 0.0
    content = np.maximum(products[:2] - noise * pixels / _CORRELATED, _CONTENT * products[:2])
    correlation = min(1.0, max(0.0, products[2]) / math.sqrt(float(content.prod())))
    chance = math.sqrt(_CORRELATED / pixels * float((products[:2] / content).prod()))
    # As many pixels as the energy is spread over, and as are independent: a single bright spot is like any other.
    count = min(_INDEPENDENT, float(products[0] * features[1] / (2.0 * math.pi * max(features[0], 1e-30))))
    unlike = _UNLIKE + 2.0 * chance
    return -0.5 * count * math.log((1.0 - correlation**2 + unlike) / (1.0 + unlike))


def _energies(image: Image) -> tuple[float, float]:
    """Sums of the fourth powers of samples, and of the squares of their differences from neighbours."""
    squares = image * image
    slopes = cv2.subtract(image[1:], image[:-1]), cv2.subtract(image[:, 1:], image[:, :-1])
    return float(np.vdot(squares, squares)), sum(float(np.vdot(slope, slope)) for slope in slopes)


def wide_peaks(tiles: Sequence[CoarseTile]) -> tuple[FloatArray, FloatArray]:
    """Places of the second tile in the first (K, 2), wherever along a side, and the evidence for them (K,), nats.

    Of the highest peaks of two whole tiles; where they nearly coincide they share the camera and not the specimen.
    """
    first, second = (tile.pixels for tile in tiles)
    sizes = np.array([first.shape, second.shape])
    shape = tuple(int(fft.next_fast_len(int(side), real=True)) for side in sizes.sum(axis=0))
    frames, noise = np.zeros((2, *shape), dtype=np.float32), []
    for frame, tile in zip(frames, (first, second), strict=True):
        weights = _taper(tile.shape[0], _EDGE)[:, None] * _taper(tile.shape[1], _EDGE)
        frame[: tile.shape[0], : tile.shape[1]] = (tile - tile.mean()) * weights
        noise.append(noise_variance(tile) * float((weights**2).sum()))
    spectra = fft.rfft2(frames)
    product = spectra[0] * np.conj(spectra[1])
    plain = fft.irfft2(product, s=shape)
    _whiten(product, *np.array(noise))
    surface = fft.irfft2(product, s=shape)
    y, x = (
        np.where(np.arange(n) < side, np.arange(n), np.arange(n) - n) for n, side in zip(shape, sizes[0], strict=True)
    )
    height, width = sizes.min(axis=0)
    common = [np.minimum(s[0], v + s[1]) - np.maximum(0, v) for v, s in ((y, sizes[:, 0]), (x, sizes[:, 1]))]
    least = [max(2.0, _MIN_COMMON * n) for n in (height, width)]
    aside = (np.abs(y)[:, None] > _MIN_STEP * height) | (np.abs(x) > _MIN_STEP * width)
    broad = (common[0][:, None] > 0.5 * height) | (common[1] > 0.5 * width)
    possible = aside & broad & (common[0][:, None] > least[0]) & (common[1] > least[1])
    deviation = normal_std(surface[possible]) + 1e-12
    found: dict[tuple[int, int], None] = {}
    # A pattern that repeats itself is as high in many places of the plain correlation, and in chance ones of the other.
    for values, threshold in ((surface, peak_threshold(deviation, surface.size)), (plain, 0.0)):
        shown = np.where(possible, values, 0.0).astype(np.float32)
        found |= dict.fromkeys((int(x[column]), int(y[row])) for column, row in peaks(shown, threshold, _WIDE_PEAKS))
    places = np.array(list(found), dtype=np.float64).reshape(-1, 2)
    boxes = [Overlap.expected(0, 1, place, sizes[:, ::-1], 1) for place in places]
    return places, np.array([log_evidence(tiles, box, at) for at, box in zip(places, boxes, strict=True)])


def peaks(surface: NDArray[Any], threshold: float, count: int) -> list[tuple[int, int]]:
    """Columns and rows of the highest peaks above a threshold, so many at most, the highest first."""
    rows, columns = np.nonzero((surface == cv2.dilate(surface, np.ones((3, 3), np.uint8))) & (surface > threshold))
    order = np.argsort(-surface[rows, columns], kind="stable")[:count]
    return list(zip(columns[order].tolist(), rows[order].tolist(), strict=True))


def peak_threshold(deviation: float, places: int) -> float:
    """Height that the highest of the peaks of noise of a standard deviation hardly reaches among so many places."""
    return deviation * math.sqrt(2.0 * math.log(places / _FALSE_ALARMS))


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
    return normal_std(second) ** 2 / 6.0


@lru_cache(maxsize=64)
def _taper(length: int, share: float = _TAPER) -> Image:
    """A window that falls to 0 as a cosine at both ends, over a share of its length."""
    distance = (np.minimum(np.arange(length), np.arange(length)[::-1]) + 0.5) / max(1.0, share * length)
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.minimum(distance, 1.0)), dtype=np.float32)
