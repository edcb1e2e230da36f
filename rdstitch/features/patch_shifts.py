"""Shifts between images whose contrast differs, or is reversed: phase correlation of their edges, patch by patch."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray

_COARSE_SIDE = 512  # pixels
_PATCHES = 5  # along the longer side

Edges = NDArray[np.float32]


def edges_of(pixels: NDArray[Any]) -> Edges:
    """Mark where the contrast of an image (h, w) or (h, w, C) is strong, whatever its sign."""
    grey = pixels.astype(np.float32) if pixels.ndim == 2 else pixels[..., :3].mean(axis=2, dtype=np.float32)
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    steep = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    # The few strongest edges shall not outweigh all others.
    level = float(np.median(steep)) or float(steep.mean()) or 1.0
    return np.log1p(steep / level).astype(np.float32)


def _shift(first: Edges, second: Edges) -> FloatArray:
    """Measure how many pixels (x, y) further right and down the second shows the same."""
    window = cv2.createHanningWindow((first.shape[1], first.shape[0]), cv2.CV_32F)
    (x, y), _ = cv2.phaseCorrelate(first - first.mean(), second - second.mean(), window)
    return np.array([x, y])


def coarse_shift(first: Edges, second: Edges) -> FloatArray:
    """Measure how many pixels (x, y) further right and down the second image shows the same, by both made small."""
    factor = min(1.0, _COARSE_SIDE / max(first.shape))
    size = round(first.shape[1] * factor), round(first.shape[0] * factor)
    small = [cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (first, second)]
    return np.asarray(_shift(small[0].astype(np.float32), small[1].astype(np.float32)) / factor)


def patch_shifts(first: Edges, second: Edges, expected: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Middles of patches of the first image, and where the second shows them near where expected, (2, P, 2)."""
    height, width = first.shape
    side = max(32, max(width, height) // _PATCHES // 2 * 2)
    corners = np.array(
        [(x, y) for y in range(0, height - side + 1, side // 2) for x in range(0, width - side + 1, side // 2)]
    )
    points = corners.astype(np.float64).reshape(-1, 2) + (side - 1) / 2
    starts = np.rint(expected(points) - points)
    starts = np.where(np.isfinite(starts), starts, 0.0).astype(np.intp) + corners.reshape(-1, 2)
    matches = []
    for (x, y), (u, v), point in zip(corners.reshape(-1, 2).tolist(), starts.tolist(), points, strict=True):
        if 0 <= u <= width - side and 0 <= v <= height - side:
            moved = _shift(first[y : y + side, x : x + side], second[v : v + side, u : u + side])
            matches.append((point, point + moved + np.array([u - x, v - y])))
    return np.array(matches).reshape(-1, 2, 2).swapaxes(0, 1)
