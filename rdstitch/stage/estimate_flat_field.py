"""The flat field of tiles from the tiles themselves, whatever they show.

What a tile shows changes as often from light to dark across a cell's border as from dark to light; the light changes
there in every tile alike. So the medians, over all tiles, of the logarithmic steps between neighbouring cells are those
of the illumination, which is a smooth surface over them.

The dark level D, which light does not multiply, is where the variance of photon noise, which is in proportion to the
light, becomes 0 (photon transfer). Few samples, and those that are no counts of light, as of JPEG files, show none: D
is taken for 0, and the error of the flat field is what D may be instead.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.io.flat_field import FlatField
from rdstitch.io.reduction import block_mean
from rdstitch.robust.loss import NORMAL_MEDIAN, normal_std

MIN_TILES = 20  # fewer show one flat field as well as another
LARGEST_ERROR = 0.01  # root mean square, by which two halves of the tiles may differ from their mean
_PARTS = 4  # of the tiles, by which the error of the dark level is known
_KNOWN = 3.0  # standard deviations from 0 from which on it is taken out
_MAX_DARK = 1 / 16  # of the largest sample: cameras of 12 bits are set to a hundred counts
_CELLS = 24  # cells along each side of a tile at most, or one a pixel where it has fewer
_SIDE = 512  # pixels of the longer side that are enough
_DEGREE = 4  # degree of the polynomial that the logarithm of the illumination is
_TRUNCATED = 0.9113  # variance of a standard normal number within 2.5 of its mean
# bins of brightness, and cells of a bin, by which noise is compared with light
_BINS, _LEAST_BINS, _LEAST_IN_BIN = 24, 6, 16


@dataclass(frozen=True, eq=False)
class Illumination:
    """The flat field that tiles show, or why they do not."""

    field: FlatField | None  # None where two halves of the tiles do not show the same
    error: float  # its root mean square error, by how far two halves of the tiles differ
    shading: float  # largest share of the light that is missing
    dark: FloatArray  # (C,)
    dark_error: FloatArray  # (C,): its standard deviation; 0 where the tiles do not show it, and it is 0


class _Statistics:
    """Ground, and variance of noise and the light that it is of, of all cells of all tiles."""

    def __init__(self, tiles: Iterable[NDArray[Any]]) -> None:
        ground, light, variance, largest = [], [], [], 0.0
        for tile in tiles:
            factor = max(1, round(max(tile.shape[:2]) / _SIDE))
            small = block_mean(tile, factor).reshape(-(-tile.shape[0] // factor), -(-tile.shape[1] // factor), -1)
            ground.append(np.median(_cells(small.astype(np.float32)), axis=-1))
            mean, noise = _noise_of_ground(tile.reshape(*tile.shape[:2], -1))
            light.append(mean)
            variance.append(noise)
            largest = max(largest, float(tile.max()))
        self.size, self.largest = small.shape[:2], largest
        self.used = tuple(math.prod(_cell_grid(side)) for side in self.size)
        self.ground, self.light, self.variance = (np.array(v, dtype=np.float64) for v in (ground, light, variance))


def _cells(plane: NDArray[Any]) -> NDArray[Any]:
    """The samples of each cell of a plane (h, w, C), (cells down, cells across, C, n)."""
    (down, rows), (across, columns) = (_cell_grid(side) for side in plane.shape[:2])
    parts = plane[: down * rows, : across * columns].reshape(down, rows, across, columns, -1)
    return parts.transpose(0, 2, 4, 1, 3).reshape(down, across, plane.shape[2], -1)


def _cell_grid(side: int) -> tuple[int, int]:
    """Cells along a side of a tile, and pixels of each: less than one cell's are left over at the end."""
    pixels = -(-side // _CELLS)
    return side // pixels, pixels


def _noise_of_ground(tile: NDArray[Any]) -> tuple[FloatArray, FloatArray]:
    """Mean and variance of the noise of the ground in each cell of a tile (h, w, C), by second differences in rows.

    The ground is the half of the samples next to which, in the rows between, the light is nearest to its median: noise
    of bright spots is not held against the ground, and what is left out does not depend on the noise.
    """
    rows = tile[: tile.shape[0] // 2 * 2].astype(np.float32)
    rows, between = rows[::2], rows[1::2]
    smoothed = _cells(between[:, :-2] + between[:, 1:-1] + between[:, 2:])
    away = np.abs(smoothed - np.median(smoothed, axis=-1, keepdims=True))
    half = max(1, away.shape[-1] // 2)
    ground = np.argpartition(away, half - 1, axis=-1)[..., :half]
    second = _cells(np.abs(rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:]))
    second, light = (np.take_along_axis(values, ground, axis=-1) for values in (second, _cells(rows[:, 1:-1])))
    # Squares of what is within 2.5 standard deviations, which whole numbers do not make coarse as their median is.
    inside = second <= np.maximum(np.median(second, axis=-1, keepdims=True), 1.0) * (2.5 / NORMAL_MEDIAN)
    variance = np.where(inside, second**2, 0.0).sum(axis=-1) / np.maximum(inside.sum(axis=-1), 1) / _TRUNCATED
    return np.asarray(light.mean(axis=-1)), np.asarray(variance / 6.0)


@dataclass(frozen=True, eq=False)
class _Channel:
    """What tiles show of the light in one of their channels."""

    surface: FloatArray  # coefficients of the logarithm of the illumination
    dark: float
    dark_error: float  # 0 where the tiles do not show it, and it is 0
    halves_error: float  # by which two halves of the tiles differ from their mean; root mean squares of shares
    dark_effect: float  # by what the dark level may be instead
    spread: float  # of the illumination itself

    @classmethod
    def of(cls, statistics: _Statistics, channel: int) -> "_Channel":
        ground = statistics.ground[..., channel]
        dark, dark_error = _sure_dark_level(statistics.light[..., channel], statistics.variance[..., channel])
        # Where it is not shown, all are as likely up to the largest that cameras have: its root mean square.
        largest = min(_MAX_DARK * statistics.largest, float(np.quantile(ground, 0.01)))
        other = dark + dark_error if dark_error else largest / math.sqrt(3.0)
        parts = ground - dark, ground[::2] - dark, ground[1::2] - dark, ground - other
        down, across = (_middles(cells) for cells in ground.shape[1:])
        surfaces = [_fitted(part) for part in parts]
        cells = [np.exp(_surface(surface, across, down)) for surface in surfaces]
        whole, half1, half2, darker = (light / light.mean() for light in cells)
        halves, effect = (float(np.sqrt((off**2).mean())) for off in ((half1 - half2) / 2.0, darker - whole))
        return cls(surfaces[0], dark, dark_error, halves, effect, float(whole.std()))

    @property
    def sure(self) -> bool:
        """Whether its flat field is better than none."""
        return math.hypot(self.halves_error, self.dark_effect) < min(LARGEST_ERROR, 0.5 * self.spread)

    @property
    def error(self) -> float:
        """As of one of the halves: what both have in common, such as the form of the surface, is not seen."""
        return math.hypot(math.sqrt(2.0) * self.halves_error, self.dark_effect)


def estimate_illumination(read: Callable[[int], NDArray[Any]], count: int) -> Illumination:
    """Estimate the flat field and the dark level of tiles."""
    first = read(0)
    # Second differences in every other row take two rows of three samples.
    if count < MIN_TILES or first.shape[0] < 2 or first.shape[1] < 3:
        return Illumination(None, math.inf, 0.0, np.zeros(1), np.zeros(1))
    cells = _Statistics(read(index) for index in range(count))
    channels = [_Channel.of(cells, channel) for channel in range(cells.ground.shape[3])]
    # Centres of the pixels in the frame of the cells, from -1 to 1.
    x, y = (
        2.0 * (np.arange(first.shape[axis]) + 0.5) * cells.size[axis] / first.shape[axis] / cells.used[axis] - 1.0
        for axis in (1, 0)
    )
    gain = np.stack([np.exp(_surface(channel.surface, x, y)) for channel in channels], axis=-1).astype(np.float32)
    gain /= gain.mean(axis=(0, 1))
    dark, dark_error = (np.array(v) for v in zip(*((each.dark, each.dark_error) for each in channels), strict=True))
    good = all(channel.sure for channel in channels) and bool(np.isfinite(gain).all())
    field = FlatField(gain, dark.astype(np.float32)[None, None]) if good else None
    missing = float(1.0 - (gain.min(axis=(0, 1)) / gain.max(axis=(0, 1))).min())
    return Illumination(field, max(channel.error for channel in channels), missing, dark, dark_error)


def _sure_dark_level(light: FloatArray, variance: FloatArray) -> tuple[float, float]:
    """D of a channel and its standard deviation, by parts of the tiles; 0 and 0 where they do not show it."""
    dark = _dark_level(light, variance)
    parts = [_dark_level(light[k::_PARTS], variance[k::_PARTS]) for k in range(_PARTS)]
    error = float(np.std(parts, ddof=1)) / math.sqrt(_PARTS)
    return (dark, error) if all(parts) and dark >= _KNOWN * error else (0.0, 0.0)


def agrees_with_overlaps(field: FlatField, overlaps: Iterable[tuple[NDArray[Any], NDArray[Any], FloatArray]]) -> bool:
    """Whether content differs between two tiles (h, w[, C]), the second at a place in the first, as by the field."""
    measured, expected = [], []
    for first, second, offset in overlaps:
        x, y = np.rint(offset).astype(int).tolist()
        (h1, w1), (h2, w2) = first.shape[:2], second.shape[:2]
        here = np.s_[max(0, y) : min(h1, y + h2), max(0, x) : min(w1, x + w2)]
        there = np.s_[max(0, -y) : min(h2, h1 - y), max(0, -x) : min(w2, w1 - x)]
        parts = [np.atleast_3d(part) - field.dark[0, 0] for part in (first[here], second[there])]
        height, width = parts[0].shape[:2]
        for rows in np.array_split(np.arange(height), max(1, round(height / h1 * _CELLS))):
            for columns in np.array_split(np.arange(width), max(1, round(width / w1 * _CELLS))):
                cell = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
                a, b = (part[cell].mean(axis=(0, 1)) for part in parts)
                f, g = (field.gain[part][cell].mean(axis=(0, 1)) for part in (here, there))
                positive = (a > 0.0) & (b > 0.0)
                measured += np.log(a[positive] / b[positive]).tolist()
                expected += np.log(f[positive] / g[positive]).tolist()
    r, f = np.array(measured), np.array(expected)
    if not len(r) or not (f**2).sum() > 0.0:
        return False
    weights, slope = np.ones(len(r)), 0.0
    for _ in range(5):
        slope = float((weights * r * f).sum() / (weights * f**2).sum())
        off = np.abs(r - slope * f)
        weights = 1.0 / np.maximum(off, np.median(off) + 1e-9)
    return slope > 0.5


def _powers() -> list[tuple[int, int]]:
    """Exponents of x and y; the constant is left out, since the gain has mean 1."""
    return [(i, k) for i in range(_DEGREE + 1) for k in range(_DEGREE + 1 - i) if i + k]


def _surface(coefficients: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """The polynomial at columns x and rows y, (h, w)."""
    table = np.zeros((_DEGREE + 1, _DEGREE + 1))
    for (i, k), value in zip(_powers(), coefficients, strict=True):
        table[k, i] = value
    return np.asarray(np.polynomial.polynomial.polygrid2d(y, x, table))


def _middles(cells: int) -> FloatArray:
    """Of the cells along a side, from -1 to 1."""
    return np.asarray((2.0 * np.arange(cells) + 1.0) / cells - 1.0)


def _fitted(light: FloatArray) -> FloatArray:
    """Coefficients of the logarithm of the illumination, from light (N, cells down, cells across)."""
    logarithm = np.log(np.maximum(light, max(1e-3 * float(np.median(light)), 1e-9)))
    values = [np.median(np.diff(logarithm, axis=axis), axis=0).ravel() for axis in (1, 2)]
    x, y = np.meshgrid(_middles(light.shape[2]), _middles(light.shape[1]))
    powers = np.array([x**i * y**k for i, k in _powers()])
    matrix = np.hstack([np.diff(powers, axis=axis).reshape(len(powers), -1) for axis in (1, 2)]).T
    right = np.concatenate(values)
    weights = np.ones(len(right))
    for _ in range(5):
        solution = np.linalg.lstsq(matrix * weights[:, None], right * weights, rcond=None)[0]
        residual = right - matrix @ solution
        scale = max(normal_std(residual), 1e-12)
        weights = 1.0 / (1.0 + (residual / (3.0 * scale)) ** 2)
    return np.asarray(solution)


def _dark_level(ground: FloatArray, variance: FloatArray) -> float:
    """D of a channel by its photon noise, whose variance is in proportion to the light; 0 where that is not so."""
    mean, noise = ground.ravel(), variance.ravel()
    count = min(_BINS, len(mean) // _LEAST_IN_BIN)
    if count < _LEAST_BINS:
        return 0.0
    bins = np.array_split(np.argsort(mean), count)
    x = np.array([np.median(mean[part]) for part in bins])
    # Of each bin the lower part: texture, too, is taken for noise.
    y = np.array([np.quantile(noise[part], 0.25) for part in bins])
    first, second = np.triu_indices(len(x), 1)
    distinct = x[second] - x[first] > 0.0
    slopes = (y[second] - y[first])[distinct] / (x[second] - x[first])[distinct]
    low, slope = np.quantile(slopes, [0.16, 0.5]) if len(slopes) else (0.0, 0.0)
    if not low > 0.0:
        return 0.0
    dark = float(np.median(x - y / slope))
    return dark if 0.0 < dark < float(np.quantile(mean, 0.01)) else 0.0
