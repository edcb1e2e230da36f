"""Matches of overlapping images on their plane or sphere, and what the alignment leaves over at each of them."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray, Rows
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import from_directions, from_plane, to_directions, to_plane
from rdstitch.local_alignment.field import DisplacementField
from rdstitch.numerics.nearest_points import separate_neighbours
from rdstitch.system.late_imports import csgraph, sparse

# Share of the image's diagonal: matches farther off are taken to be wrong. Where the ground rises by a tenth of the
# camera's height, and the alignment is that of the valleys, right ones are nearly as far off.
_SEARCH_RADIUS = 0.15
_MIN_MATCHES = 8


@dataclass(frozen=True, eq=False)
class PutativeMatches:
    """Putative matches of one pair of images: measured pixels (N, 2) of either."""

    image1: int
    image2: int
    points1: FloatArray
    points2: FloatArray


@dataclass(frozen=True, eq=False)
class ImagesOnSurface:
    """Where the alignment puts the images: on a plane, or on a sphere about a camera that turned on the spot.

    Places (..., D) are in pixels of the median image: (x, y) on the plane, points in space of the sphere.
    """

    cameras: Sequence[Camera]
    # (N, 3, 3): normalized undistorted coordinates of each image to the plane, or to directions
    homographies: FloatArray
    on_sphere: bool
    # pixels of the median image per unit of the plane, or radian, at the images' centres; NaN if none is there
    scale: float

    @classmethod
    def of(cls, cameras: Sequence[Camera], homographies: FloatArray, *, on_sphere: bool = False) -> Self:
        """Images at the scale of the median image."""
        unscaled = cls(cameras, homographies, on_sphere, 1.0)
        steps = np.array([(0.5, 0.0), (0.0, 0.5), (-0.5, 0.0), (0.0, -0.5)])
        areas = []
        for k, camera in enumerate(cameras):
            around = unscaled.to_surface(k, (np.array(camera.image_size) - 1.0) / 2.0 + steps)
            if np.isfinite(around).all():  # a centre beyond the horizon is nowhere on the plane
                sides = around[:2] - around[2:]
                areas.append(float(np.sqrt(np.linalg.det(sides @ sides.T))))
        return replace(unscaled, scale=float(np.median(areas) ** -0.5) if areas else np.nan)

    def to_surface(self, image: int, points: FloatArray) -> FloatArray:
        """Places (M, D) of measured pixels (M, 2); NaN beyond the horizon."""
        camera, matrix = self.cameras[image], self.homographies[image]
        if not self.on_sphere:
            return self.scale * to_plane(camera, matrix, points)
        directions = to_directions(camera, matrix, points)
        return np.asarray(self.scale * directions / np.linalg.norm(directions, axis=1, keepdims=True))

    def from_surface(self, image: int, places: FloatArray) -> FloatArray:
        """Measured pixels (M, 2) of places (M, D); NaN where the image cannot show them."""
        camera, matrix = self.cameras[image], self.homographies[image]
        return (from_directions if self.on_sphere else from_plane)(camera, matrix, places / self.scale)


@dataclass(frozen=True, eq=False)
class PlacedMatches(Rows):
    """Matches of one pair of images, or of many, one pair after the other."""

    images: NDArray[np.intp]  # (M, 2): the two images of each match
    points: FloatArray  # (M, 2, 2): measured pixels in either
    places: FloatArray  # (M, 2, D): where the alignment puts either
    scale: FloatArray  # (M,): half the diagonal of the first image, pixels

    @classmethod
    def join(cls, parts: Iterable[Self]) -> Self:
        """All of them, one after the other."""
        none = cls(np.empty((0, 2), np.intp), np.empty((0, 2, 2)), np.empty((0, 2, 2)), np.empty(0))
        return cls.concatenate(list(parts) or [none])

    @cached_property
    def residual(self) -> FloatArray:
        """Residuals (M, D) from where the second image puts matches to where the first does."""
        return np.asarray(self.places[:, 0] - self.places[:, 1])

    def residual_with(self, fields: Sequence[DisplacementField], images: ImagesOnSurface) -> FloatArray:
        """Residuals between images displaced by their fields; without these where one of them shows no such place."""
        points, places = self.points.reshape(-1, 2), self.places.reshape(2 * len(self), -1).copy()
        for k, chosen in self.of_image:
            places[chosen] = images.to_surface(k, fields[k].expected(points[chosen]))
        first, second = np.moveaxis(places.reshape(self.places.shape), 1, 0)
        return np.where(np.isfinite(first + second), first - second, self.residual)

    @cached_property
    def of_image(self) -> tuple[tuple[int, NDArray[np.intp]], ...]:
        """Every image with matches, and which of the 2 M places are in it."""
        order = np.argsort(self.images.ravel(), kind="stable")
        images, first = np.unique(self.images.ravel()[order], return_index=True)
        return tuple(zip(images.tolist(), np.split(order, first[1:]), strict=True))

    @cached_property
    def tracks(self) -> NDArray[np.intp]:
        """Number of each match's track: matches that share keypoints, and so their errors, have the same.

        The longest tracks, which wrong matches make of many, come first.
        """
        keypoint, count = np.empty(2 * len(self), dtype=np.intp), 0
        for _, chosen in self.of_image:
            keypoints, each = np.unique(self.points.reshape(-1, 2)[chosen] @ (1.0, 1.0j), return_inverse=True)
            keypoint[chosen] = count + each
            count += len(keypoints)
        edges = sparse.coo_array((np.ones(len(self)), (keypoint[::2], keypoint[1::2])), (count, count))
        track = csgraph.connected_components(edges, directed=False)[1][keypoint[::2]]
        longest_first = np.argsort(-np.bincount(track), kind="stable")
        return np.argsort(longest_first)[track]

    @cached_property
    def neighbours(self) -> NDArray[np.intp]:
        """The nearest match of another feature of the same pair of images, for each; itself where there is none."""
        new_pair = (self.images[1:] != self.images[:-1]).any(axis=1)
        first = np.concatenate([[0], np.flatnonzero(new_pair) + 1, [len(self)]])
        nearest_other = np.empty(len(self), dtype=np.intp)
        for start, stop in pairwise(first.tolist()):
            points = self.points[start:stop, 0] / self.scale[start:stop, None]
            nearest_other[start:stop] = start + separate_neighbours(points)[1]
        return nearest_other

    @cached_property
    def noise(self) -> float:
        """Median length of what a residual does not have in common with its neighbour's, and no smooth field mends."""
        differences = self.residual - self.residual[self.neighbours]
        return float(np.median(np.linalg.norm(differences, axis=1)) / np.sqrt(2.0))

    def thinned(self, most: int) -> "PlacedMatches":
        """At most about so many of the matches, evenly chosen, and no fewer than a few."""
        count = min(len(self), max(most, _MIN_MATCHES))
        return self if count == len(self) else self.take(np.linspace(0, len(self) - 1, count).astype(np.intp))


def place_matches(matches: Iterable[PutativeMatches], images: ImagesOnSurface) -> Iterator[PlacedMatches]:
    """Place the matches of each pair that lie near each other: inliers of the alignment, and a little farther off.

    Pairs that have hardly any are left out.
    """
    for match in matches:
        pair, measured = (match.image1, match.image2), np.stack([match.points1, match.points2], axis=1)
        placed = np.stack([images.to_surface(k, measured[:, part]) for part, k in enumerate(pair)], axis=1)
        radius = _SEARCH_RADIUS * min(2.0 * images.cameras[k].scale for k in pair)
        near = np.linalg.norm(placed[:, 0] - placed[:, 1], axis=1) < radius
        if (count := int(near.sum())) >= _MIN_MATCHES:
            scale = np.full(count, images.cameras[match.image1].scale)
            yield PlacedMatches(np.tile(np.array(pair), (count, 1)), measured[near], placed[near], scale)
