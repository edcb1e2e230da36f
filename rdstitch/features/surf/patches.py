"""Square patches of the picture, rotated and scaled to their keypoints, for many keypoints at once, and their filters.

Reading each patch from a level of the pyramid that is just finer than the patch stands for the box sums of the
paper; rotated boxes gathered from the integral image would alias.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features.surf.hessian import Grey, to_level

_MAX_SUM = 2.0**24 / 255 - 1000  # of the absolute values of one filter, with room for rounding


def integer_kernels(kernels: FloatArray) -> tuple[NDArray[np.float32], float]:
    """Round filters of zero sum to integers of zero sum.

    Parameters
    ----------
    kernels : ndarray of shape (pixels, filters)

    Returns
    -------
    rounded : ndarray of shape (pixels, filters), float32
    factor : float
        Divide the products by this.
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
    """Sample a square grid around each point.

    Parameters
    ----------
    levels : list of ndarray
        The picture's pyramid.
    points : ndarray of shape (N, 2)
        Centres of the grids, pixels.
    spacing : ndarray of shape (N,)
        Between neighbouring samples, pixels.
    angle : ndarray of shape (N,)
        Direction of the grids' first axis, radians.
    count : int
        Samples along each side.

    Returns
    -------
    ndarray of shape (N, count, count), uint8
        Rows along the second axis of the grid.
    """
    patches = np.empty((len(points), count, count), np.uint8)
    finest = np.clip(np.floor(np.log2(spacing)), 0, len(levels) - 1).astype(np.intp)
    place = np.arange(count, dtype=np.float32) - np.float32((count - 1) / 2)
    for level, picture in enumerate(levels):
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
                picture,
                map_u.reshape(flat),
                map_v.reshape(flat),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            patches[here[part]] = values.reshape(-1, count, count)
    return patches


# Keypoints at a time, few enough that their grids stay in the cache.
_KEYPOINTS = 64
