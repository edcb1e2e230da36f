"""Square patches of the picture, rotated and scaled to their keypoints, for many keypoints at once.

Reading each patch from a level of the pyramid that is just finer than the patch stands for the box sums of the
paper; rotated boxes gathered from the integral image would alias.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features.surf.pyramid import Grey, to_level


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
