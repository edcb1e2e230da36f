"""Square patches around keypoints, read from a pyramid of the image, and filters on them that are exact.

Patches are rotated and scaled to their keypoints. Reading each from a level of the pyramid that is just finer than the
patch stands for the box sums of the paper; rotated boxes gathered from the integral image would alias.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray

Grey = NDArray[np.uint8]

_MAX_SUM = 2.0**24 / 255 - 1000  # of the absolute values of one filter, with room for rounding
_KEYPOINTS = 64  # at a time, few enough that their grids stay in the cache


def pyramid(grey: Grey, levels: int) -> list[Grey]:
    """At most ``levels`` levels, the image itself first; an odd last row or column is left out of the next."""
    result = [grey]
    while len(result) < levels and min(result[-1].shape) >= 4:
        height, width = result[-1].shape
        even = result[-1][: height // 2 * 2, : width // 2 * 2]
        result.append(np.asarray(cv2.resize(even, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.uint8))
    return result


def to_level(points: FloatArray, level: int) -> FloatArray:
    """Pixels of the image to pixels of a level; (0, 0) is the centre of the first pixel in both."""
    return (points + 0.5) / float(2**level) - 0.5


def from_level(points: FloatArray, level: int) -> FloatArray:
    """Pixels of a level to pixels of the image."""
    return (points + 0.5) * float(2**level) - 0.5


def integer_kernels(kernels: FloatArray) -> tuple[NDArray[np.float32], float]:
    """Round filters (pixels, filters) of zero sum to integers of zero sum; divide products with them by the factor.

    A BLAS sums in an order of its own, which may change with the number of threads. Filters of integers small enough
    for all sums with 8-bit patches to fit float32's 24 bits give the same result in any order.
    """
    factor = float(_MAX_SUM / np.abs(kernels).sum(axis=0).max())
    rounded = np.rint(kernels * factor)
    # What rounding adds to the sum, a handful of units in 65,000, goes to the largest weight.
    rounded[np.abs(rounded).argmax(axis=0), np.arange(kernels.shape[1])] -= rounded.sum(axis=0)
    return rounded.astype(np.float32), factor


def apply_kernels(patches: NDArray[np.uint8], kernels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Products of patches (N, side, side) with filters (side², M), exact, shape (N, M)."""
    return patches.reshape(len(patches), -1).astype(np.float32) @ kernels


def sample_patches(
    levels: list[Grey], points: FloatArray, spacing: FloatArray, angle: FloatArray, count: int
) -> NDArray[np.uint8]:
    """Sample square grids, (N, count, count), around points (N, 2) of a pyramid; rows along their second axis.

    Samples are ``spacing`` (N,) pixels apart; the first axis points ``angle`` (N,) radians from u towards v.
    """
    patches = np.empty((len(points), count, count), np.uint8)
    finest = np.clip(np.floor(np.log2(spacing)), 0, len(levels) - 1).astype(np.intp)
    place = np.arange(count, dtype=np.float32) - np.float32((count - 1) / 2)
    for level, image in enumerate(levels):
        here = np.flatnonzero(finest == level)
        centre = to_level(points[here], level).astype(np.float32)
        step = spacing[here] / 2**level
        along = (step * np.cos(angle[here])).astype(np.float32)[:, None] * place
        across = (step * np.sin(angle[here])).astype(np.float32)[:, None] * place
        u = centre[:, :1] + along
        v = centre[:, 1:] + across
        for start in range(0, len(here), _KEYPOINTS):
            part = slice(start, start + _KEYPOINTS)
            map_u = u[part, None, :] - across[part, :, None]
            map_v = v[part, None, :] + along[part, :, None]
            flat = (len(map_u), count * count)
            values = cv2.remap(
                image, map_u.reshape(flat), map_v.reshape(flat), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            patches[here[part]] = values.reshape(-1, count, count)
    return patches
