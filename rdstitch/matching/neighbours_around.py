"""Pairs of images taken from one centre that show a part of each other."""

from collections.abc import Sequence

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera, border_of

_MIN_OVERLAP = 0.15
"""Share of the image of which more is seen in the other."""

_PLACES = 7
"""Places along each side of an image that are looked up in others."""


def neighbours_around(
    cameras: Sequence[Camera], directions: FloatArray, tried: set[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Pairs that overlap and that were not tried yet.

    Parameters
    ----------
    cameras : sequence of Camera
    directions : ndarray of shape (N, 3, 3)
        From undistorted normalized coordinates of each image to directions; NaN for images without a pose.
    tried : set of (int, int)
        Pairs (i, j), i < j.
    """
    known = np.flatnonzero(np.isfinite(directions).all(axis=(1, 2))).tolist()
    rays = {k: _rays(cameras[k], directions[k]) for k in known}
    back = {k: np.linalg.inv(directions[k]) for k in known}
    axes = directions[known, :, 2] / np.linalg.norm(directions[known, :, 2], axis=1, keepdims=True)
    reach = np.array([_reach(cameras[k], directions[k], axis) for k, axis in zip(known, axes, strict=True)])
    # Only cones around the optical axes that meet: of many images all round, few of the pairs.
    near = (
        (i, known[position])
        for first, i in enumerate(known)
        for position in np.flatnonzero(_angles(axes[first:], axes[first]) <= reach[first:] + reach[first]) + first
        if known[position] != i
    )
    return [
        (i, j)
        for i, j in near
        if (i, j) not in tried
        and max(_share_seen(rays[a], cameras[b], back[b]) for a, b in ((i, j), (j, i))) >= _MIN_OVERLAP
    ]


def _rays(camera: Camera, matrix: FloatArray) -> FloatArray:
    """Directions (K, 3) of a grid of places in an image."""
    width, height = camera.image_size
    share = (np.arange(_PLACES) + 0.5) / _PLACES
    places = np.stack(np.meshgrid(share * width - 0.5, share * height - 0.5), axis=-1).reshape(-1, 2)
    flat = camera.normalize(camera.undistort(places))
    rays: FloatArray = np.concatenate([flat, np.ones((len(flat), 1))], axis=1) @ matrix.T
    return rays


def _reach(camera: Camera, matrix: FloatArray, axis: FloatArray) -> float:
    """Largest angle, radians, between the optical axis and what an image shows."""
    flat = camera.normalize(camera.undistort(border_of(camera.image_size, _PLACES)))
    if not np.isfinite(flat).all():
        return np.pi
    rays = np.concatenate([flat, np.ones((len(flat), 1))], axis=1) @ matrix.T
    return float(_angles(rays / np.linalg.norm(rays, axis=1, keepdims=True), axis).max())


def _angles(directions: FloatArray, axis: FloatArray) -> FloatArray:
    """Radians between unit vectors (K, 3) and one."""
    angles: FloatArray = np.arccos(np.clip(directions @ axis, -1.0, 1.0))
    return angles


def _share_seen(rays: FloatArray, camera: Camera, back: FloatArray) -> float:
    """Share of directions (K, 3) that an image shows; ``back`` leads to its undistorted normalized coordinates."""
    x, y, z = back @ rays.T
    flat = np.stack([x, y], axis=1) / np.where(z > 0.0, z, np.nan)[:, None]
    u, v = camera.distort(camera.denormalize(flat)).T
    width, height = camera.image_size
    return float(np.mean((u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)))
