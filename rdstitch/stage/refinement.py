"""Displacements of blocks to a fraction of a pixel, by Newton's method on their correlation, with their covariance."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray, IntArray, Rows
from rdstitch.stage.coarse_tile import CORRELATED, Image

_SMOOTHING = 1.2  # standard deviation of the filter before derivatives are taken, pixels
_MARGIN = 5  # pixels of the second tile about a block that are looked at
_STEP = 8  # pixels between which the lens is straight
_ITERATIONS = 5
_SETTLED = 0.003  # pixels that an iteration moves, which is the last one then
_MIN_SIDE = 12  # pixels of a block
_SIGNIFICANT = 5.0  # standard deviations by which the correlation of a block must exceed that of noise
_CORRELATED = CORRELATED * _SMOOTHING**2  # pixels that share their noise after the filter

PointMap = Callable[[FloatArray], FloatArray]
Gradient = list[Image]


@dataclass(frozen=True, eq=False)
class BlockMatches(Rows):
    """Matches of the blocks of overlaps."""

    # points1, points2: (M, 2): measured places of the same content in the first and the second tile, pixels
    points1: FloatArray
    points2: FloatArray
    information: FloatArray  # (M, 2, 2): inverse covariance of their difference, 1/pixels²

    @classmethod
    def none(cls) -> "BlockMatches":
        return cls(np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2, 2)))

    @property
    def std(self) -> float:
        """Standard deviation of their mean in the worst direction, pixels: along an edge it is large."""
        least = float(np.linalg.eigvalsh(self.information.sum(axis=0))[0]) if len(self) else 0.0
        return 1.0 / math.sqrt(least) if least > 0.0 else math.inf


def refine(
    first: NDArray[Any], second: NDArray[Any], blocks: IntArray, transfer: PointMap, tolerance: float
) -> BlockMatches:
    """Refine where blocks (K, 4) of the first tile (h, w) are in the second; ``tolerance`` pixels off at most."""
    matches = [match for block in blocks if (match := _refined(first, second, block, transfer, tolerance)) is not None]
    return BlockMatches.concatenate([BlockMatches.none(), *matches])


def _refined(
    first: NDArray[Any], second: NDArray[Any], block: IntArray, transfer: PointMap, tolerance: float
) -> BlockMatches | None:
    """The match of one block; None where it shows nothing."""
    pair = _sampled_pair(first, second, block, transfer)
    displaced = None if pair is None else _displaced(pair, min(tolerance, _MARGIN - 2.0))
    if pair is None or displaced is None or not displaced.significant:
        return None
    point = (pair.low + _centroid(displaced.gradient))[None]
    return BlockMatches(point, transfer(point) - displaced.shift, displaced.information[None])


@dataclass(frozen=True, eq=False)
class _SampledPair:
    """A block of the first tile, and what may be the same in the second; both smoothed."""

    low: IntArray  # (2,): first pixel of the block in its tile
    block: Image
    other: Image
    maps: Image  # (h, w, 2): where ``other`` has the pixels of the block


def _sampled_pair(
    first: NDArray[Any], second: NDArray[Any], block: IntArray, transfer: PointMap
) -> _SampledPair | None:
    """Sample a block as far as both tiles have what the search may need; None where that is too small."""
    sides = np.array([first.shape[::-1], second.shape[::-1]])
    corners = np.array([block[[0, 1]], block[[2, 1]], block[[0, 3]], block[[2, 3]]], dtype=np.float64)
    off = corners - transfer(corners)
    low = np.maximum(block[:2], np.maximum(0, np.ceil(off.max(axis=0)).astype(np.intp)) + _MARGIN)
    high = np.minimum(block[2:], np.minimum(sides[0], sides[1] + np.floor(off.min(axis=0)).astype(np.intp)) - _MARGIN)
    if (high - low < _MIN_SIDE).any():
        return None
    across, down = (_interpolation(side) for side in (high - low).tolist())
    nodes = np.stack(
        np.meshgrid(*(a + _STEP * np.arange(m.shape[1]) for a, m in zip(low, (across, down), strict=True))), axis=-1
    )
    lattice = transfer(nodes.reshape(-1, 2).astype(np.float64)).reshape(nodes.shape)
    moved = np.stack([down @ lattice[..., k] @ across.T for k in (0, 1)], axis=-1)
    corner = np.maximum(np.floor(moved.min(axis=(0, 1))).astype(np.intp) - _MARGIN, 0)
    stop = np.minimum(np.ceil(moved.max(axis=(0, 1))).astype(np.intp) + _MARGIN + 1, sides[1])
    maps = (moved - corner).astype(np.float32)
    return _SampledPair(low, _smooth(first, low, high), _smooth(second, corner, stop), maps)


@dataclass(frozen=True, eq=False)
class _Displaced:
    """Both images of a block when the second is displaced so that they agree; means 0, equally bright."""

    shift: FloatArray  # (2,), pixels
    first: Image
    second: Image
    weight: Image
    gradient: Gradient  # weighted mean of both
    hessian: FloatArray  # (2, 2): of half of their squared difference by the shift

    @property
    def significant(self) -> bool:
        """Whether they correlate by more than noise would."""
        total = float(self.weight.sum())
        power = float((self.weight * self.first * self.first).sum())
        correlation = float((self.weight * self.first * self.second).sum()) / power
        return bool(correlation * np.sqrt(total / _CORRELATED) >= _SIGNIFICANT)

    @property
    def information(self) -> FloatArray:
        """Inverse covariance (2, 2) of the shift, by what is left of their difference."""
        left = float((self.weight * (self.first - self.second) ** 2).sum())
        noise, weight = left / float(self.weight.sum()) * _CORRELATED, np.maximum(self.weight, 1e-6)
        energy = np.array([[float((a * b / weight).sum()) for b in self.gradient] for a in self.gradient])
        return np.asarray(self.hessian @ np.linalg.pinv(noise * energy) @ self.hessian)


def _displaced(pair: _SampledPair, tolerance: float) -> _Displaced | None:
    """Newton's method on the correlation; None where it leaves the tolerance, or nothing has structure."""
    weight = _window(*pair.block.shape)
    first, deviation = _centred(pair.block, weight)
    without_light = _without_illumination(first, weight)
    gradient1 = without_light(_gradient(first))
    shift, displaced = np.zeros(2), None
    for _ in range(_ITERATIONS):
        x, y = (pair.maps[..., k] - np.float32(shift[k]) for k in (0, 1))
        # Smoothed, so that linear interpolation will do; OpenCV's cubic kernel moves content by up to 0.05 pixels.
        sampled = cv2.remap(pair.other, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        second, spread = _centred(np.asarray(sampled, dtype=np.float32), weight)
        if not min(spread, deviation) > 0.0:
            return None
        second *= np.float32(deviation / spread)
        gradient2 = without_light(_gradient(second))
        mean = [(a + b) * np.float32(0.5) * weight for a, b in zip(gradient1, gradient2, strict=True)]
        # The gradients of both images in one product: noise, which they do not share, is not taken for structure.
        hessian = np.array([[float((weight * a * b).sum()) for b in gradient2] for a in gradient1])
        hessian = (hessian + hessian.T) / 2.0
        if np.linalg.det(hessian) <= 0.0 or np.trace(hessian) <= 0.0:
            return None
        step = -np.linalg.solve(hessian, [float((g * (first - second)).sum()) for g in mean])
        shift = shift + np.clip(step, -1.0, 1.0)
        if np.abs(shift).max() > tolerance:
            return None
        displaced = _Displaced(shift, first, second, weight, mean, hessian)
        if np.abs(step).max() < _SETTLED:
            break
    return displaced


def _centred(image: Image, weight: Image) -> tuple[Image, float]:
    """An image without its weighted mean, and its standard deviation."""
    total = float(weight.sum())
    centred = image - np.float32(float((weight * image).sum()) / total)
    return centred, math.sqrt(float((weight * centred * centred).sum()) / total)


@lru_cache(maxsize=256)
def _interpolation(length: int) -> FloatArray:
    """Weights by which values at every eighth pixel give those at all of a length, linearly."""
    place, node = np.divmod(np.arange(length), _STEP)[::-1]
    weights = np.zeros((length, -(-length // _STEP) + 1))
    weights[np.arange(length), node] = 1.0 - place / _STEP
    weights[np.arange(length), node + 1] = place / _STEP
    return weights


def _smooth(tile: NDArray[Any], low: IntArray, high: IntArray) -> Image:
    part = tile[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    return np.asarray(cv2.GaussianBlur(part, (0, 0), _SMOOTHING, borderType=cv2.BORDER_REFLECT), dtype=np.float32)


def _gradient(image: Image) -> Gradient:
    """Derivatives by x and y, central differences."""
    kernel = np.array([[-0.5, 0.0, 0.5]], dtype=np.float32)
    return [np.asarray(cv2.filter2D(image, -1, k), dtype=np.float32) for k in (kernel, kernel.T)]


def _without_illumination(image: Image, weight: Image) -> Callable[[Gradient], Gradient]:
    """What is left of a gradient without what a change of illumination over a block may look like.

    That is a ramp in front of the image, or one that multiplies it: neighbours have their overlap on opposite sides.
    """
    height, width = image.shape
    x = np.linspace(-1.0, 1.0, width, dtype=np.float32)[None]
    y = np.linspace(-1.0, 1.0, height, dtype=np.float32)[:, None]
    ramps = [np.ones_like(image), x + 0.0 * image, y + 0.0 * image]
    basis = np.stack([*ramps, *(ramp * image for ramp in ramps)]).reshape(6, -1)
    weighted = basis * weight.ravel()
    inverse = np.linalg.pinv((weighted @ basis.T).astype(np.float64)).astype(np.float32)

    def project(gradient: Gradient) -> Gradient:
        return [part - ((inverse @ (weighted @ part.ravel())) @ basis).reshape(part.shape) for part in gradient]

    return project


def _window(height: int, width: int) -> Image:
    """Weights that fall to 0 within a few pixels of the border."""

    def side(length: int) -> Image:
        distance = np.minimum(np.arange(length), np.arange(length)[::-1]) + 0.5
        return np.asarray(np.minimum(1.0, distance / min(6.0, length / 4.0)), dtype=np.float32)

    return np.asarray(side(height)[:, None] * side(width), dtype=np.float32)


def _centroid(gradients: Gradient) -> FloatArray:
    """Middle of what has structure, (x, y)."""
    energy = gradients[0] ** 2 + gradients[1] ** 2
    columns, rows = energy.sum(axis=0, dtype=np.float64), energy.sum(axis=1, dtype=np.float64)
    return np.array([values @ np.arange(len(values)) / max(values.sum(), 1e-30) for values in (columns, rows)])
