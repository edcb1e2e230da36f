"""What the adjustment is given: a link, the correspondences of two pictures that agree with one relation."""

from dataclasses import dataclass, replace
from typing import Self

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.matching.thinning import spread_choice
from rdstitch.radial_homography import RadialHomography


@dataclass(frozen=True)
class Link:
    """Two pictures that overlap.

    Attributes
    ----------
    image1, image2 : int
        Indices of the pictures.
    points1, points2 : ndarray of shape (M, 2)
        Where the inliers of the pair were measured, pixels of the one and of the other picture.
    relation : RadialHomography
        The pair's own estimate, from ``image1`` to ``image2``.
    count : int, optional
        Number of the inliers, where these points are only some of them.
    """

    image1: int
    image2: int
    points1: FloatArray
    points2: FloatArray
    relation: RadialHomography
    count: int | None = None

    def __post_init__(self) -> None:
        """Check that the parts fit together."""
        if self.image1 == self.image2:
            raise ArgumentError(f"picture {self.image1} cannot be linked with itself")
        if self.points1.shape != self.points2.shape or self.points1.ndim != 2 or self.points1.shape[1] != 2:
            raise ArgumentError(f"expected points (M, 2), not {self.points1.shape} and {self.points2.shape}")
        if not self.relation:
            raise ArgumentError(f"pictures {self.image1} and {self.image2}: a failed fit makes no link")

    def __len__(self) -> int:
        """Number of inliers."""
        return len(self.points1) if self.count is None else self.count

    def thinned(self, most: int | None) -> Self:
        """About ``most`` of the correspondences at the most, well spread over the overlap; the number stays."""
        kept = spread_choice(self.points1, most)
        return replace(self, points1=self.points1[kept], points2=self.points2[kept], count=len(self))
