"""Matches of all overlapping pictures on the common plane, and what the alignment leaves over at each of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.radial_homography import to_plane

# Matches that the alignment expects farther away than this share of the picture's diagonal are taken to be wrong; where
# the ground rises by a tenth of the camera's height, right ones are up to half as far apart.
_SEARCH_RADIUS = 0.08
_MIN_MATCHES = 8


@dataclass(frozen=True)
class Match:
    """Putative matches of one pair of pictures: measured pixels (N, 2) of either."""

    image1: int
    image2: int
    points1: FloatArray
    points2: FloatArray


@dataclass(frozen=True)
class PlaneMatches:
    """Matches of all pairs, one after the other.

    Lengths on the plane are in pixels of the median picture.

    Attributes
    ----------
    images : ndarray of shape (M, 2)
        The two pictures of each match.
    points : ndarray of shape (M, 2, 2)
        Measured pixels in either.
    residual : ndarray of shape (M, 2)
        From where the second picture puts it to where the first does, on the plane.
    """

    images: NDArray[np.intp]
    points: FloatArray
    residual: FloatArray

    def __len__(self) -> int:
        return len(self.residual)

    def take(self, chosen: NDArray[np.bool_]) -> "PlaneMatches":
        """A part of them."""
        return PlaneMatches(self.images[chosen], self.points[chosen], self.residual[chosen])


def plane_scale(cameras: Sequence[Camera], homographies: FloatArray) -> float:
    """Pixels of the median picture per unit of the plane, at the pictures' centres; NaN if it shows none of them."""
    middles = [(np.array(camera.image_size) - 1.0) / 2.0 for camera in cameras]
    found = [jacobians(c, g, m[None])[0] for c, g, m in zip(cameras, homographies, middles, strict=True)]
    # A centre beyond the horizon is nowhere on the plane.
    areas = [abs(np.linalg.det(jacobian)) for jacobian in found if np.isfinite(jacobian).all()]
    return float(np.median(areas) ** -0.5) if areas else math.nan


def jacobians(camera: Camera, homography: FloatArray, points: FloatArray) -> FloatArray:
    """Derivative of the plane coordinates by the measured pixels, (N, 2, 2), by central differences."""
    steps = np.array([(0.5, 0.0), (0.0, 0.5)])
    ahead, behind = (to_plane(camera, homography, points[:, None] + sign * steps) for sign in (1.0, -1.0))
    return np.asarray(np.swapaxes(ahead - behind, -1, -2), dtype=np.float64)


def place_matches(
    matches: Sequence[Match], cameras: Sequence[Camera], homographies: FloatArray, scale: float
) -> PlaneMatches | None:
    """Matches that lie near each other on the plane, the inliers of the alignment and those a little farther off.

    None where there are hardly any.
    """
    images, points, residuals = [], [], []
    for match in matches:
        pair = (match.image1, match.image2)
        placed = [
            scale * to_plane(cameras[k], homographies[k], p)
            for k, p in zip(pair, (match.points1, match.points2), strict=True)
        ]
        residual = placed[0] - placed[1]
        radius = _SEARCH_RADIUS * min(2.0 * cameras[k].half_diagonal for k in pair)
        near = np.linalg.norm(residual, axis=1) < radius
        if near.sum() >= _MIN_MATCHES:
            images.append(np.broadcast_to(np.array(pair), (int(near.sum()), 2)))
            points.append(np.stack([match.points1[near], match.points2[near]], axis=1))
            residuals.append(residual[near])
    if not images:
        return None
    return PlaneMatches(np.concatenate(images), np.concatenate(points), np.concatenate(residuals))
