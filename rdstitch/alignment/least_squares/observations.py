"""The correspondences of all links as flat arrays, thinned so that each link costs the same."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.camera import Camera
from rdstitch.matching.links import Link, grid_subsample
from rdstitch.numerics.robust_loss import ALIGNMENT_WIDTH, sigma_of

_CHUNK = 4096  # correspondences linearized at a time: what stays in cache
_STATIC = 1.0  # pixels that the displacements of most correspondences of a link stay below where the camera stood still


@dataclass(frozen=True, eq=False)
class Observations:
    """Correspondences of L links, one after the other."""

    image1: IntArray  # image1, image2: (L,): indices of the images of each link
    image2: IntArray
    start: IntArray  # (L + 1,): link l has the correspondences ``start[l]:start[l + 1]``
    points1: FloatArray  # points1, points2: (M, 2): measured, in half diagonals from the camera's distortion centre
    points2: FloatArray
    scale1: FloatArray  # scale1, scale2: (L,): half the diagonal of each link's images, pixels
    scale2: FloatArray
    matches: IntArray  # (L,): correspondences that each link had before thinning
    # radius in half diagonals out to which a lens must be one-to-one: the corners, unless a given one is not
    reach: float = 1.0
    # (M, 2): by how much a standard deviation of the ground's height moves each point in the second image, over the
    # standard deviation of the noise, see relief_weights; none over a plane
    relief: FloatArray | None = None

    @classmethod
    def from_links(cls, links: Sequence[Link], cameras: Sequence[Camera]) -> Self:
        """The points of links, normalized by the cameras of their images."""
        sizes = [camera.scale for camera in cameras]
        index1, index2 = np.array([(link.image1, link.image2) for link in links], dtype=np.intp).reshape(-1, 2).T
        empty = [np.empty((0, 2))]
        return cls(
            index1,
            index2,
            np.concatenate([[0], np.cumsum([len(link.points1) for link in links])]).astype(np.intp),
            np.concatenate(empty + [cameras[link.image1].normalize(link.points1) for link in links]),
            np.concatenate(empty + [cameras[link.image2].normalize(link.points2) for link in links]),
            np.array([sizes[i] for i in index1]),
            np.array([sizes[j] for j in index2]),
            np.array([len(link) for link in links], dtype=np.intp),
            min([1.0, *(camera.drawn_radius / camera.scale for camera in cameras)]),
        )

    def __len__(self) -> int:
        """Number of links."""
        return len(self.image1)

    @property
    def most(self) -> int:
        """Correspondences of the link that has the most."""
        return int(np.diff(self.start).max(initial=0))

    @cached_property
    def link(self) -> IntArray:
        """The link of each correspondence, shape (M,)."""
        return np.repeat(np.arange(len(self)), np.diff(self.start))

    @cached_property
    def image_count(self) -> int:
        """Number of images that have links."""
        return len(np.unique([self.image1, self.image2]))

    def sigma(self, squared: FloatArray) -> float:
        """Standard deviation of an error's coordinate, pixels, by ``|r|²`` (M,); inf where most are."""
        return sigma_of(squared[self.scale_inliers_mask])

    def inliers(self, squared: FloatArray) -> BoolArray:
        """Errors (M,) within the width of the loss, by ``|r|²`` (M,)."""
        return squared < (ALIGNMENT_WIDTH * self.sigma(squared)) ** 2

    @cached_property
    def scale_inliers_mask(self) -> BoolArray:
        """Which correspondences, shape (M,), the scale of the errors is estimated from: all but those of static links.

        What stays where it is in the image is localised in the same pixel again, without the errors that a change of
        view brings: by the scale of a camera that stands still for a while, all other links would be outliers. All
        correspondences where every link is static.
        """
        distance = np.linalg.norm(self.points2 - self.points1, axis=1) * self.scale1[self.link]
        moving = np.repeat(self.medians(distance) > _STATIC, np.diff(self.start))
        return moving if moving.any() else np.ones_like(moving)

    @cached_property
    def chunks(self) -> list[tuple[int, int]]:
        """Ranges of links with about :data:`_CHUNK` correspondences each."""
        edges = np.searchsorted(self.start, np.arange(0, self.start[-1] + _CHUNK, _CHUNK)).clip(max=len(self))
        return list(itertools.pairwise(np.unique(edges).tolist()))

    @property
    def areas(self) -> FloatArray:
        """Product of the principal standard deviations of ``points1`` of each link, shape (L,); half diagonals²."""
        counts = np.diff(self.start)
        means = np.stack([np.bincount(self.link, x, len(self)) for x in self.points1.T], axis=1)
        x, y = (self.points1 - (means / np.maximum(counts, 1)[:, None])[self.link]).T
        xx, yy, xy = (np.bincount(self.link, z, len(self)) / np.maximum(counts, 1) for z in (x * x, y * y, x * y))
        return np.sqrt(np.maximum(xx * yy - xy * xy, 0.0))

    def medians(self, values: FloatArray) -> FloatArray:
        """Median of one value (M,) per correspondence over each link, shape (L,); inf where a link has none."""
        counts = np.diff(self.start)
        if not counts.any():
            return np.full(len(counts), np.inf)
        # Links have about as many correspondences each, and rows of a rectangle are sorted much faster than parts.
        rows = np.full((len(counts), int(counts.max())), np.inf)
        rows[self.link, np.arange(len(values)) - np.repeat(self.start[:-1], counts)] = values
        rows.sort(axis=1)
        ends = [rows[np.arange(len(rows)), np.maximum(place, 0)] for place in ((counts - 1) // 2, counts // 2)]
        with np.errstate(invalid="ignore"):
            return np.where(counts > 0, (ends[0] + ends[1]) / 2.0, np.inf)

    def subset(self, links: IntArray | BoolArray, image_index: IntArray | None = None) -> Self:
        """Only some links; with ``image_index`` (N,) images get new numbers."""
        chosen = np.flatnonzero(links) if np.asarray(links).dtype == np.bool_ else np.asarray(links)
        counts = np.diff(self.start)[chosen]
        rows = np.arange(counts.sum()) + np.repeat(self.start[chosen] - (np.cumsum(counts) - counts), counts)
        of_links = {name: getattr(self, name)[chosen] for name in ("scale1", "scale2", "matches")}
        image1, image2 = self.image1[chosen], self.image2[chosen]
        if image_index is not None:
            image1, image2 = image_index[image1], image_index[image2]
        return replace(self.rows(rows, counts), image1=image1, image2=image2, **of_links)

    def rows(self, rows: IntArray, counts: IntArray) -> Self:
        """Only some correspondences, so many (L,) of each link."""
        start = np.concatenate([[0], np.cumsum(counts)]).astype(np.intp)
        relief = None if self.relief is None else self.relief[rows]
        return replace(self, start=start, points1=self.points1[rows], points2=self.points2[rows], relief=relief)

    def thinned(self, most: int) -> Self:
        """At most about ``most`` correspondences of each link, well spread over its overlap."""
        if self.most <= most:
            return self
        kept = [grid_subsample(self.points1[a:b], most) + a for a, b in itertools.pairwise(self.start)]
        return self.rows(np.concatenate([np.empty(0, dtype=np.intp), *kept]), np.array([len(k) for k in kept]))
