"""Matches of overlapping images on the common plane, and what the alignment leaves over at each of them."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.late_imports import spatial
from rdstitch.radial_homography import from_plane, to_plane

# Matches that the alignment expects farther away than this share of the image's diagonal are taken to be wrong; where
# the ground rises by a tenth of the camera's height, and the alignment is that of the valleys, right ones are nearly as
# far apart.
_SEARCH_RADIUS = 0.15
_MIN_MATCHES = 8


@dataclass(frozen=True)
class Match:
    """Putative matches of one pair of images: measured pixels (N, 2) of either."""

    image1: int
    image2: int
    points1: FloatArray
    points2: FloatArray


@dataclass(frozen=True, eq=False)
class ImagesOnPlane:
    """Where the alignment puts the images; places on the plane are in pixels of the median image.

    Attributes
    ----------
    cameras : sequence of Camera
    homographies : ndarray of shape (N, 3, 3)
        Normalized undistorted coordinates of each image to the plane.
    scale : float
        Pixels of the median image per unit of the plane, at the images' centres; NaN if it shows none of them.
    """

    cameras: Sequence[Camera]
    homographies: FloatArray
    scale: float

    @classmethod
    def of(cls, cameras: Sequence[Camera], homographies: FloatArray) -> Self:
        """With the scale of the median image."""
        steps = np.array([(0.5, 0.0), (0.0, 0.5), (-0.5, 0.0), (0.0, -0.5)])
        areas = []
        for camera, matrix in zip(cameras, homographies, strict=True):
            around = to_plane(camera, matrix, (np.array(camera.image_size) - 1.0) / 2.0 + steps)
            if np.isfinite(around).all():  # a centre beyond the horizon is nowhere on the plane
                areas.append(abs(np.linalg.det(around[:2] - around[2:])))
        return cls(cameras, homographies, float(np.median(areas) ** -0.5) if areas else np.nan)

    def to_plane(self, image: int, points: FloatArray) -> FloatArray:
        """Places (M, 2) of measured pixels (M, 2); NaN beyond the horizon."""
        return self.scale * to_plane(self.cameras[image], self.homographies[image], points)

    def from_plane(self, image: int, places: FloatArray) -> FloatArray:
        """Measured pixels (M, 2) of places (M, 2); NaN where the image cannot show them."""
        return from_plane(self.cameras[image], self.homographies[image], places / self.scale)


@dataclass(frozen=True, eq=False)
class PlaneMatches:
    """Matches of one pair of images, or of many, one pair after the other.

    Attributes
    ----------
    images : ndarray of shape (M, 2)
        The two images of each match.
    points : ndarray of shape (M, 2, 2)
        Measured pixels in either.
    places : ndarray of shape (M, 2, 2)
        Where the alignment puts either on the plane, pixels of the median image.
    """

    images: NDArray[np.intp]
    points: FloatArray
    places: FloatArray

    def __len__(self) -> int:
        return len(self.images)

    @classmethod
    def join(cls, parts: Iterable["PlaneMatches"]) -> Self:
        """All of them, one after the other."""
        every = list(parts)
        return cls(*(np.concatenate([getattr(p, name) for p in every]) for name in ("images", "points", "places")))

    @cached_property
    def residual(self) -> FloatArray:
        """From where the second image puts them to where the first does, (M, 2)."""
        return np.asarray(self.places[:, 0] - self.places[:, 1])

    @cached_property
    def of_image(self) -> tuple[tuple[int, NDArray[np.intp]], ...]:
        """Every image with matches, and which of the 2 M places are in it."""
        order = np.argsort(self.images.ravel(), kind="stable")
        images, first = np.unique(self.images.ravel()[order], return_index=True)
        return tuple(zip(images.tolist(), np.split(order, first[1:]), strict=True))

    @cached_property
    def neighbours(self) -> NDArray[np.intp]:
        """For each match the nearest other one of the same pair of images; itself where there is none."""
        new_pair = (self.images[1:] != self.images[:-1]).any(axis=1)
        first = np.concatenate([[0], np.flatnonzero(new_pair) + 1, [len(self)]])
        found = np.empty(len(self), dtype=np.intp)
        for start, stop in pairwise(first.tolist()):
            points = self.points[start:stop, 0]
            nearest = np.asarray(spatial.cKDTree(points).query(points, k=2)[1])[:, 1]
            found[start:stop] = start + np.minimum(nearest, len(points) - 1)
        return found

    @cached_property
    def noise(self) -> float:
        """Median length of what a residual does not have in common with its neighbour's, and no smooth field mends."""
        apart = self.residual - self.residual[self.neighbours]
        return float(np.median(np.linalg.norm(apart, axis=1)) / np.sqrt(2.0))

    def thinned(self, share: float) -> "PlaneMatches":
        """About such a share of them, evenly."""
        return self.take(np.linspace(0, len(self) - 1, round(share * len(self))).astype(np.intp))

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> "PlaneMatches":
        """A part of them."""
        return PlaneMatches(self.images[chosen], self.points[chosen], self.places[chosen])


def place_matches(matches: Iterable[Match], images: ImagesOnPlane) -> Iterator[PlaneMatches]:
    """For each pair, matches that lie near each other on the plane: inliers of the alignment, and a little farther off.

    Pairs that have hardly any are left out.
    """
    for match in matches:
        pair, measured = (match.image1, match.image2), np.stack([match.points1, match.points2], axis=1)
        placed = np.stack([images.to_plane(k, measured[:, part]) for part, k in enumerate(pair)], axis=1)
        radius = _SEARCH_RADIUS * min(2.0 * images.cameras[k].scale for k in pair)
        near = np.linalg.norm(placed[:, 0] - placed[:, 1], axis=1) < radius
        if (count := int(near.sum())) >= _MIN_MATCHES:
            yield PlaneMatches(np.tile(np.array(pair), (count, 1)), measured[near], placed[near])
