"""The data of one pair of pictures, as robust estimation sees it."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.errors import ArgumentError


@dataclass(frozen=True)
class Measurements:
    """Corresponding points of two pictures, normalized by half the diagonal of their picture.

    Attributes
    ----------
    x1, x2 : ndarray of shape (N, 2)
        Normalized measured points.
    camera1, camera2 : Camera
        The pictures' frames; one lens, so λ is shared.
    quality : ndarray of shape (N,) or None
        The higher, the more likely a correspondence is right; None where nothing is known.
    """

    x1: FloatArray
    x2: FloatArray
    camera1: Camera
    camera2: Camera
    quality: FloatArray | None = None

    @classmethod
    def from_pixels(
        cls,
        points1: FloatArray,
        points2: FloatArray,
        camera1: Camera,
        camera2: Camera,
        quality: FloatArray | None,
    ) -> "Measurements":
        """Check and normalize measured points (N, 2), px."""
        for name, points in (("points1", points1), ("points2", points2)):
            if points.ndim != 2 or points.shape[1] != 2:
                raise ArgumentError(f"{name} must have shape (N, 2), not {points.shape}")
            if not np.isfinite(points).all():
                raise ArgumentError(f"{name} has values that are not finite")
        if len(points1) != len(points2):
            raise ArgumentError(f"points1 and points2 differ in length: {len(points1)} and {len(points2)}")
        if quality is not None and quality.shape != (len(points1),):
            raise ArgumentError(f"quality must have shape ({len(points1)},), not {quality.shape}")
        return cls(camera1.normalize(points1), camera2.normalize(points2), camera1, camera2, quality)

    def subset(self, chosen: NDArray[Any]) -> "Measurements":
        """The chosen correspondences, given by index or as a mask."""
        quality = None if self.quality is None else self.quality[chosen]
        return replace(self, x1=self.x1[chosen], x2=self.x2[chosen], quality=quality)

    def __len__(self) -> int:
        """Number of correspondences."""
        return len(self.x1)

    @property
    def px(self) -> float:
        """Pixels of picture 2 in one normalized unit of picture 2."""
        return self.camera2.half_diagonal

    @property
    def px_ratio(self) -> float:
        """Pixels of picture 2 that one pixel of picture 1 becomes when normalized coordinates are kept."""
        return self.camera2.half_diagonal / self.camera1.half_diagonal
