"""The eccentricity of keypoints: the middle of a blob's image is not the image of its middle.

Perspective and lens enlarge one side of what a detector of blobs has found more than the other, so that the keypoint
moves against the point that it shows, by the square of its size: photogrammetry knows it of circular targets (Heikkilä,
PAMI 22(10), 2000). Beside a fine keypoint's noise it is nothing. The squares of a chessboard that is seen obliquely
through a fisheye move by two pixels, all of them to the same side, which no number of matches averages out.
"""

from collections.abc import Callable

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.features import Features

_RADIUS = {"sift": 0.78, "rootsift": 0.78, "surf": 0.27}
"""Radius of the disc to which each kind of detector gives a keypoint, in that keypoint's diameters; measured.

A disc is found at a standard deviation of its radius over √2, which is ``size / 2`` to ``size / 1.6`` for SIFT's
difference of two Gaussians. What finds corners places them alike at any size.
"""

_VERTICES = 16  # of the polygon that stands for the disc: 3 % of the shift are lost with it
_TURNS = 2.0 * np.pi * np.arange(_VERTICES) / _VERTICES
_CIRCLE = np.column_stack([np.cos(_TURNS), np.sin(_TURNS)])


def blob_radii(features: Features) -> FloatArray:
    """Radii (N,), pixels, of discs that would be found as keypoints of these sizes; 0 where it is corners."""
    return _RADIUS.get(features.kind, 0.0) * features.scale


def eccentricity(transfer: Callable[[FloatArray], FloatArray], points: FloatArray, radii: FloatArray) -> FloatArray:
    """How far the middles of discs lie from their centres in the other image.

    Parameters
    ----------
    transfer : callable
        Takes points (M, 2) of the one image, pixels, to points of the other; NaN where that does not see them.
    points : ndarray of shape (N, 2)
        Centres of the discs in the one image, pixels.
    radii : ndarray of shape (N,)
        Their radii, pixels.

    Returns
    -------
    ndarray of shape (N, 2)
        Pixels of the other image; NaN where that does not see the whole disc.
    """
    outline = points[:, None] + radii[:, None, None] * _CIRCLE
    seen = transfer(outline.reshape(-1, 2)).reshape(outline.shape) - transfer(points)[:, None]
    after = np.roll(seen, -1, axis=1)
    cross = seen[..., 0] * after[..., 1] - seen[..., 1] * after[..., 0]
    area = cross.sum(axis=1)  # twice that; a polygon's centroid is that of its triangles
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = np.einsum("nk,nkc->nc", cross, seen + after) / (3.0 * area[:, None])
    return np.where(radii[:, None] > 0.0, middle, 0.0)
