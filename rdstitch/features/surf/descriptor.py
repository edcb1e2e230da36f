"""The descriptor: sums of Haar responses in 4 x 4 cells of a rotated patch (Bay et al., §4.2)."""

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features.surf.patches import sample_patches
from rdstitch.features.surf.pyramid import Grey

_CELLS = 4  # along each side
_SAMPLES = 5  # along each side of a cell
_SIDE = _CELLS * _SAMPLES  # of the region, in units of s
_SIGMA = 3.3  # of the Gaussian weight, in units of s
_SUPERSAMPLING = 2  # samples along each side of a square of s
_KEYPOINTS = 512  # worked on at a time


def describe_patches(
    levels: list[Grey], points: FloatArray, scale: FloatArray, angle: FloatArray, extended: bool
) -> NDArray[np.float32]:
    """Descriptors of unit length, shape (N, 64), or (N, 128) if extended; of no contrast: zeros.

    Parameters
    ----------
    levels : list of ndarray
        The picture's pyramid.
    points : ndarray of shape (N, 2)
        pixels.
    scale : ndarray of shape (N,)
        The s of the paper, pixels.
    angle : ndarray of shape (N,)
        Orientation, radians.
    extended : bool
        Sum responses of either sign of the other direction separately.
    """
    descriptors = np.empty((len(points), _CELLS**2 * (8 if extended else 4)), np.float32)
    for start in range(0, len(points), _KEYPOINTS):
        part = slice(start, start + _KEYPOINTS)
        patches = sample_patches(
            levels, points[part], scale[part] / _SUPERSAMPLING, angle[part], _SUPERSAMPLING * (_SIDE + 1)
        )
        descriptors[part] = _describe(_shrink(patches), extended)
    return descriptors


def _shrink(patches: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Sums over squares of s, shape (N, 21, 21)."""
    n, side, _ = patches.shape
    k = _SUPERSAMPLING
    rows = patches.reshape(n, side // k, k, side).sum(axis=2, dtype=np.int16)
    shrunk: NDArray[np.int16] = rows.reshape(n, side // k, side // k, k).sum(axis=3, dtype=np.int16)
    return shrunk.astype(np.float32)


def _describe(patches: NDArray[np.float32], extended: bool) -> NDArray[np.float32]:
    """Descriptors of patches (N, 21, 21)."""
    # Haar wavelets of side 2s, at steps of s.
    down = patches[:, 1:] + patches[:, :-1]
    du = (down[:, :, 1:] - down[:, :, :-1]) * _WEIGHTS
    right = patches[:, :, 1:] + patches[:, :, :-1]
    dv = (right[:, 1:] - right[:, :-1]) * _WEIGHTS
    if extended:
        parts = []
        for values, other in ((du, dv), (dv, du)):
            positive, negative = np.where(other >= 0, values, 0), np.where(other < 0, values, 0)
            parts += [positive, np.abs(positive), negative, np.abs(negative)]
    else:
        parts = [du, dv, np.abs(du), np.abs(dv)]
    cells = np.stack([_cell_sums(values) for values in parts], axis=-1).reshape(len(patches), -1)
    norm: NDArray[np.float32] = np.sqrt((cells**2).sum(axis=1, keepdims=True))
    return np.divide(cells, norm, out=np.zeros_like(cells), where=norm > 0)


def _cell_sums(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sums over cells, (N, 20, 20) to (N, 16)."""
    cells = values.reshape(-1, _CELLS, _SAMPLES, _CELLS, _SAMPLES)
    total: NDArray[np.float32] = cells.sum(axis=2).sum(axis=3).reshape(-1, _CELLS**2)
    return total


def _weights() -> NDArray[np.float32]:
    """Gaussian weight of each response, shape (20, 20)."""
    place = np.arange(_SIDE) - (_SIDE - 1) / 2
    return np.exp(-(place[:, None] ** 2 + place**2) / (2 * _SIGMA**2)).astype(np.float32)


_WEIGHTS = _weights()
