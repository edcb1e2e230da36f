"""Displacements of blocks to a fraction of a pixel, by Newton's method on their correlation, with their covariance."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray, IntArray

_SMOOTHING = 1.2
"""Standard deviation of the filter before derivatives are taken, pixels."""

_MARGIN = 5
_ITERATIONS = 5
_MIN_SIDE = 12
_SIGNIFICANT = 5.0
"""Standard deviations by which the correlation of a block must exceed that of noise."""

_CORRELATED = 4.0 * np.pi * _SMOOTHING**2
"""Pixels that share their noise after the filter."""


@dataclass(frozen=True)
class BlockMatches:
    """What blocks of overlaps show.

    Attributes
    ----------
    points1, points2 : ndarray of shape (M, 2)
        Measured places of the same content in the first and the second tile, pixels.
    information : ndarray of shape (M, 2, 2)
        Inverse covariance of their difference, 1/pixels².
    """

    points1: FloatArray
    points2: FloatArray
    information: FloatArray

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self.points1)


def refine(
    first: NDArray[Any], second: NDArray[Any], blocks: IntArray, displacements: FloatArray, tolerance: float
) -> BlockMatches:
    """Refine the displacements of blocks of the first tile in the second.

    Parameters
    ----------
    first, second : ndarray of shape (h, w)
    blocks : ndarray of shape (K, 4)
        Boxes in the first tile.
    displacements : ndarray of shape (K, 2)
        What is at p in the first is at ``p - displacement`` in the second, about.
    tolerance : float
        By how much that may be wrong, pixels.
    """
    found = []
    for block, displacement in zip(blocks, displacements, strict=True):
        match = _refined(first, second, block, displacement, tolerance)
        if match is not None:
            found.append(match)
    if not found:
        return BlockMatches(np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2, 2)))
    points1, points2, information = (np.array(values) for values in zip(*found, strict=True))
    return BlockMatches(points1, points2, information)


def _refined(
    first: NDArray[Any], second: NDArray[Any], block: IntArray, displacement: FloatArray, tolerance: float
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Places of a block's content in both tiles and their information; None where it shows nothing."""
    whole = np.rint(displacement).astype(np.intp)
    sides = np.array([first.shape[::-1], second.shape[::-1]])
    low = np.maximum(np.maximum(block[:2], _MARGIN), whole + _MARGIN)
    high = np.minimum(np.minimum(block[2:], sides[0] - _MARGIN), sides[1] + whole - _MARGIN)
    if (high - low < _MIN_SIDE).any():
        return None
    one = _smooth(first, low, high)
    wide = _smooth(second, low - whole - _MARGIN + 1, high - whole + _MARGIN - 1)
    inner = slice(_MARGIN - 1, 1 - _MARGIN)
    weight = _window(*one.shape)
    total = float(weight.sum())
    one -= float((weight * one).sum()) / total
    deviation = np.sqrt(float((weight * one * one).sum()) / total)
    gradient1 = _gradient(one)
    shift = np.zeros(2)
    for _ in range(_ITERATIONS):
        matrix = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
        moved = cv2.warpAffine(wide, matrix, wide.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        two = moved[inner, inner]
        two = two - float((weight * two).sum()) / total
        spread = np.sqrt(float((weight * two * two).sum()) / total)
        if not min(spread, deviation) > 0.0:
            return None
        two *= np.float32(deviation / spread)
        gradient2 = _gradient(two)
        mean = [(a + b) * np.float32(0.5) * weight for a, b in zip(gradient1, gradient2, strict=True)]
        # The gradients of both images in one product: noise, which they do not share, is not taken for structure.
        hessian = np.array([[float((weight * a * b).sum()) for b in gradient2] for a in gradient1])
        hessian = (hessian + hessian.T) / 2.0
        difference = one - two
        slope = np.array([float((g * difference).sum()) for g in mean])
        if np.linalg.det(hessian) <= 0.0 or np.trace(hessian) <= 0.0:
            return None
        step = -np.linalg.solve(hessian, slope)
        shift = shift + np.clip(step, -1.0, 1.0)
        if np.abs(shift).max() > min(tolerance, _MARGIN - 2.0):
            return None
        if np.abs(step).max() < 0.003:
            break
    correlation = float((weight * one * two).sum()) / (total * deviation**2)
    if correlation * np.sqrt(total / _CORRELATED) < _SIGNIFICANT:
        return None
    noise = float((weight * difference**2).sum()) / total * _CORRELATED
    energy = np.array([[float((a * b / np.maximum(weight, 1e-6)).sum()) for b in mean] for a in mean])
    covariance = noise * energy
    information = hessian @ np.linalg.pinv(covariance) @ hessian
    point = low + _centroid(mean)
    return point, point - whole - shift, information


def _smooth(tile: NDArray[Any], low: IntArray, high: IntArray) -> NDArray[np.float32]:
    part = tile[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    return np.asarray(cv2.GaussianBlur(part, (0, 0), _SMOOTHING, borderType=cv2.BORDER_REFLECT), dtype=np.float32)


def _gradient(image: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Derivatives by x and y, central differences."""
    kernel = np.array([[-0.5, 0.0, 0.5]], dtype=np.float32)
    return [np.asarray(cv2.filter2D(image, -1, k), dtype=np.float32) for k in (kernel, kernel.T)]


def _window(height: int, width: int) -> NDArray[np.float32]:
    """Weights that fall to 0 within a few pixels of the border."""

    def side(length: int) -> NDArray[np.float32]:
        distance = np.minimum(np.arange(length), np.arange(length)[::-1]) + 0.5
        return np.asarray(np.minimum(1.0, distance / min(6.0, length / 4.0)), dtype=np.float32)

    return np.asarray(side(height)[:, None] * side(width), dtype=np.float32)


def _centroid(gradients: list[NDArray[np.float32]]) -> FloatArray:
    """Middle of what has structure, (x, y)."""
    energy = gradients[0] ** 2 + gradients[1] ** 2
    columns, rows = energy.sum(axis=0, dtype=np.float64), energy.sum(axis=1, dtype=np.float64)
    return np.array([values @ np.arange(len(values)) / max(values.sum(), 1e-30) for values in (columns, rows)])
