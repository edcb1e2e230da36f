"""The flat field of tiles from the tiles themselves, whatever they show.

What a tile shows changes as often from light to dark across a cell's border as from dark to light; the light changes
there in every tile alike. So the medians, over all tiles, of the logarithmic steps between neighbouring cells are those
of the illumination, which is a smooth surface over them.

Where tiles do not show their dark level (:mod:`rdstitch.stage.dark_level`), it is taken for 0, and the error of the
flat field is what it may be instead.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.io.flat_field import FlatField
from rdstitch.io.reduction import block_mean
from rdstitch.numerics.robust_loss import NORMAL_MEDIAN, normal_std
from rdstitch.stage.dark_level import DarkLevel, dark_level

_MIN_TILES = 20  # fewer show one flat field as well as another
LARGEST_ERROR = 0.01  # root mean square, by which two halves of the tiles may differ from their mean
_MAX_DARK = 1 / 16  # of the largest sample: cameras of 12 bits are set to a hundred counts
_CELLS = 24  # cells along each side of a tile at most, or one a pixel where it has fewer
_SIDE = 512  # pixels of the longer side that are enough
_DEGREE = 4  # degree of the polynomial that the logarithm of the illumination is
# Exponents of x and y; the constant is left out, since the gain has mean 1.
_POWERS = [(i, k) for i in range(_DEGREE + 1) for k in range(_DEGREE + 1 - i) if i + k]
_TRUNCATED = 0.9113  # variance of a standard normal number within 2.5 of its mean


class FlatFieldUnknown(Enum):
    """Why tiles do not show a flat field."""

    FEW_TILES = auto()
    UNSURE = auto()  # two halves of them do not show the same, or each has too few pixels


@dataclass(frozen=True, eq=False)
class Illumination:
    """The flat field that tiles show."""

    field: FlatField
    error: float  # its root mean square error, by how far two halves of the tiles differ
    shading: float  # largest fraction of the light that is missing
    dark: tuple[DarkLevel | None, ...]  # of each channel; None where the tiles do not show it, and it is taken for 0


@dataclass(frozen=True, eq=False)
class _Statistics:
    """What the cells of T tiles hold; (T, cells down, cells across, C) each."""

    ground: FloatArray
    light: FloatArray  # of which ``variance`` is the noise
    variance: FloatArray
    size: tuple[int, int]  # height and width of a tile that was made small, pixels
    largest: float  # sample

    @classmethod
    def of(cls, tiles: Iterable[NDArray[Any]]) -> "_Statistics":
        cells, size, largest = [], (0, 0), 0.0
        for tile in tiles:
            factor = max(1, round(max(tile.shape[:2]) / _SIDE))
            size = -(-tile.shape[0] // factor), -(-tile.shape[1] // factor)
            ground = np.median(_cells(block_mean(tile, factor).reshape(*size, -1).astype(np.float32)), axis=-1)
            cells.append((ground, *_noise_of_ground(tile.reshape(*tile.shape[:2], -1))))
            largest = max(largest, float(tile.max()))
        ground, light, variance = (np.array(values, dtype=np.float64) for values in zip(*cells, strict=True))
        return cls(ground, light, variance, size, largest)


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
    dark: DarkLevel | None
    halves_error: float  # rms of fractions, by which two halves of the tiles differ from their mean
    dark_effect: float  # rms of fractions, by what the dark level may be instead
    spread: float  # of the illumination itself

    @classmethod
    def of(cls, statistics: _Statistics, channel: int) -> "_Channel":
        ground = statistics.ground[..., channel]
        shown = dark_level(statistics.light[..., channel], statistics.variance[..., channel])
        # Where it is not shown, all are as likely up to the largest that cameras have: its root mean square.
        largest = min(_MAX_DARK * statistics.largest, float(np.quantile(ground, 0.01)))
        dark, other = (0.0, largest / math.sqrt(3.0)) if shown is None else (shown.level, shown.level + shown.std)
        parts = ground - dark, ground[::2] - dark, ground[1::2] - dark, ground - other
        down, across = (_middles(cells) for cells in ground.shape[1:])
        surfaces = [_fitted(part) for part in parts]
        cells = [np.exp(_surface(surface, across, down)) for surface in surfaces]
        whole, half1, half2, darker = (light / light.mean() for light in cells)
        halves, effect = (float(np.sqrt((off**2).mean())) for off in ((half1 - half2) / 2.0, darker - whole))
        return cls(surfaces[0], shown, halves, effect, float(whole.std()))

    @property
    def sure(self) -> bool:
        """Whether its flat field is better than none."""
        return math.hypot(self.halves_error, self.dark_effect) < min(LARGEST_ERROR, 0.5 * self.spread)

    @property
    def error(self) -> float:
        """Error of one of the halves: what both have in common, such as the form of the surface, is not seen."""
        return math.hypot(math.sqrt(2.0) * self.halves_error, self.dark_effect)


def estimate_illumination(read: Callable[[int], NDArray[Any]], count: int) -> Illumination | FlatFieldUnknown:
    """Estimate the flat field and the dark level of tiles."""
    if count < _MIN_TILES:
        return FlatFieldUnknown.FEW_TILES
    first = read(0)
    # Second differences in every other row take two rows of three samples.
    if first.shape[0] < 2 or first.shape[1] < 3:
        return FlatFieldUnknown.UNSURE
    cells = _Statistics.of(read(index) for index in range(count))
    channels = [_Channel.of(cells, channel) for channel in range(cells.ground.shape[3])]
    # Centres of the pixels in the frame of the cells, from -1 to 1.
    x, y = (
        2.0 * (np.arange(first.shape[axis]) + 0.5) * cells.size[axis] / first.shape[axis] / used - 1.0
        for axis, used in ((k, math.prod(_cell_grid(cells.size[k]))) for k in (1, 0))
    )
    gain = np.stack([np.exp(_surface(channel.surface, x, y)) for channel in channels], axis=-1).astype(np.float32)
    gain /= gain.mean(axis=(0, 1))
    if not all(channel.sure for channel in channels) or not np.isfinite(gain).all():
        return FlatFieldUnknown.UNSURE
    shown = tuple(channel.dark for channel in channels)
    dark = np.array([0.0 if each is None else each.level for each in shown], dtype=np.float32)
    missing = float(1.0 - (gain.min(axis=(0, 1)) / gain.max(axis=(0, 1))).min())
    error = max(channel.error for channel in channels)
    return Illumination(FlatField(gain, dark[None, None]), error, missing, shown)


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


def _surface(coefficients: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """The polynomial at columns x and rows y, (h, w)."""
    table = np.zeros((_DEGREE + 1, _DEGREE + 1))
    for (i, k), value in zip(_POWERS, coefficients, strict=True):
        table[k, i] = value
    return np.asarray(np.polynomial.polynomial.polygrid2d(y, x, table))


def _middles(cells: int) -> FloatArray:
    """Middles of the cells along a side, from -1 to 1."""
    return np.asarray((2.0 * np.arange(cells) + 1.0) / cells - 1.0)


def _fitted(light: FloatArray) -> FloatArray:
    """Coefficients of the logarithm of the illumination, from light (N, cells down, cells across)."""
    logarithm = np.log(np.maximum(light, max(1e-3 * float(np.median(light)), 1e-9)))
    values = [np.median(np.diff(logarithm, axis=axis), axis=0).ravel() for axis in (1, 2)]
    x, y = np.meshgrid(_middles(light.shape[2]), _middles(light.shape[1]))
    powers = np.array([x**i * y**k for i, k in _POWERS])
    matrix = np.hstack([np.diff(powers, axis=axis).reshape(len(powers), -1) for axis in (1, 2)]).T
    right = np.concatenate(values)
    weights = np.ones(len(right))
    for _ in range(5):
        solution = np.linalg.lstsq(matrix * weights[:, None], right * weights, rcond=None)[0]
        residual = right - matrix @ solution
        scale = max(normal_std(residual), 1e-12)
        weights = 1.0 / (1.0 + (residual / (3.0 * scale)) ** 2)
    return np.asarray(solution)
