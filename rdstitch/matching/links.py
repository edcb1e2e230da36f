"""What the adjustment is given: a link, the correspondences of two pictures that agree with one relation."""

from dataclasses import dataclass

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
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
    """

    image1: int
    image2: int
    points1: FloatArray
    points2: FloatArray
    relation: RadialHomography

    def __post_init__(self) -> None:
        """Check that the parts fit together."""
        if self.image1 == self.image2:
            raise ArgumentError(f"picture {self.image1} cannot be linked with itself")
        if self.points1.shape != self.points2.shape or self.points1.ndim != 2 or self.points1.shape[1] != 2:
            raise ArgumentError(f"expected points (M, 2), not {self.points1.shape} and {self.points2.shape}")
        if not self.relation:
            raise ArgumentError(f"pictures {self.image1} and {self.image2}: a failed fit makes no link")

    def __len__(self) -> int:
        """Number of correspondences."""
        return len(self.points1)
