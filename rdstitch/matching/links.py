"""What the adjustment is given: a link, the correspondences of two images that agree with one relation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.radial_homography import RadialHomography, inverses


def grid_subsample(points: FloatArray, most: int | None) -> IntArray:
    """Indices of about ``most`` of the points (M, 2), ascending, evenly spread over their bounding box.

    The points are dealt out by the cells of a grid: first one of each cell, then the second of each, until there
    are enough.
    """
    count = len(points)
    if most is None or count <= most:
        return np.arange(count)
    low, high = points.min(axis=0), points.max(axis=0)
    side = max(int(np.sqrt(most)), 1)
    cell = np.minimum(((points - low) / np.maximum(high - low, 1e-12) * side).astype(np.intp), side - 1)
    number = cell[:, 0] * side + cell[:, 1]
    order = np.argsort(number, kind="stable")
    _, first, sizes = np.unique(number[order], return_index=True, return_counts=True)
    turn = np.empty(count, dtype=np.intp)
    turn[order] = np.arange(count) - np.repeat(first, sizes)
    return np.sort(np.argsort(turn, kind="stable")[:most])


@dataclass(frozen=True, eq=False)
class Link:
    """Two images that overlap."""

    image1: int  # image1, image2: indices of the images
    image2: int
    # points1, points2: (M, 2): where the inliers of the pair were measured, pixels of the one and of the other image
    points1: FloatArray
    points2: FloatArray
    relation: RadialHomography  # the pair's own estimate, from ``image1`` to ``image2``
    count: int | None = None  # number of the inliers, where these points are only some of them

    def __post_init__(self) -> None:
        """Check that the parts fit together."""
        if self.image1 == self.image2:
            raise ArgumentError(f"image {self.image1} cannot be linked with itself")
        if self.points1.shape != self.points2.shape or self.points1.ndim != 2 or self.points1.shape[1] != 2:
            raise ArgumentError(f"expected points (M, 2), not {self.points1.shape} and {self.points2.shape}")
        if not (np.isfinite(self.points1).all() and np.isfinite(self.points2).all()):
            raise ArgumentError(f"images {self.image1} and {self.image2} are linked by points that are not finite")
        if not self.relation:
            raise ArgumentError(f"images {self.image1} and {self.image2}: a failed fit makes no link")

    def __len__(self) -> int:
        """Number of inliers."""
        return len(self.points1) if self.count is None else self.count

    @property
    def sizes(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Width and height of both images, pixels."""
        return self.relation.camera.image_size, self.relation.camera2.image_size

    def reversed(self) -> Self:
        """The same correspondences, from the second image to the first."""
        one, two = self.relation.camera, self.relation.camera2
        back = self.relation.reexpressed(inverses(self.relation.homography[None])[0], two, one)
        return type(self)(self.image2, self.image1, self.points2, self.points1, back, self.count)

    def thinned(self, most: int | None) -> Self:
        """About ``most`` of the correspondences at the most, well spread over the overlap; the number stays."""
        if most is None or len(self.points1) <= most:
            return replace(self, count=len(self))
        kept = grid_subsample(self.points1, most)
        return replace(self, points1=self.points1[kept], points2=self.points2[kept], count=len(self))


def in_alternate_directions(links: Sequence[Link]) -> list[Link]:
    """The links, every other one of those along a sequence from its later image to its earlier one.

    Both ends of a correspondence have errors, but the derivatives of its transfer are taken at one (errors in
    variables). Where errors are as large as those of relief, the fit is a little off for it, depending on which image
    is transferred. All in one direction, that adds up: strips over slopes went downhill.
    """
    # The parity of the middle alternates along a sequence, whether neighbours are linked or images farther apart.
    rank = {image: k for k, image in enumerate(sorted({k for link in links for k in (link.image1, link.image2)}))}
    return [link.reversed() if (rank[link.image1] + rank[link.image2]) // 2 % 2 else link for link in links]
