"""What feature detection hands on: keypoints and descriptors of one picture."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError

Descriptors = NDArray[np.float32] | NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints of one picture with their descriptors, the strongest first.

    Attributes
    ----------
    points : ndarray of shape (N, 2), float64
        Keypoints ``(u, v)``, pixels of the full-size picture, whatever size they were detected at.
    descriptors : ndarray of shape (N, D), float32 or uint8
        Numbers that are compared by their Euclidean distance (float32), or bits, eight to a byte, that are
        compared by the Hamming distance (uint8).
    scale : ndarray of shape (N,), float64
        Diameter of the keypoint (OpenCV's ``size``), pixels of the full-size picture.
    angle : ndarray of shape (N,), float64
        Orientation, radians in [0, 2π), from u towards v; 0 where the kind has none.
    response : ndarray of shape (N,), float64
        Strength, in units of the detector.
    laplacian_sign : ndarray of shape (N,), int8, or None
        +1 for dark blobs on light ground, -1 for light ones on dark; only equal signs match. None where the
        kind has no such sign.
    kind : str
        What detected and described them; features of different kinds cannot be compared.
    image_size : (int, int), optional
        Width and height of the picture, pixels.

    Raises
    ------
    ArgumentError
        When shapes or types do not fit together, or a point is not finite.
    """

    points: FloatArray
    descriptors: Descriptors
    scale: FloatArray
    angle: FloatArray
    response: FloatArray
    laplacian_sign: NDArray[np.int8] | None
    kind: str
    image_size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        """Check shapes and types."""
        count = len(self.points)
        if self.points.shape != (count, 2) or not np.isfinite(self.points).all():
            raise ArgumentError(f"points must be finite and of shape (N, 2), not {self.points.shape}")
        if self.descriptors.ndim != 2 or len(self.descriptors) != count:
            raise ArgumentError(f"{count} points, but descriptors of shape {self.descriptors.shape}")
        if self.descriptors.dtype not in (np.float32, np.uint8):
            raise ArgumentError(f"descriptors must be float32 or uint8, not {self.descriptors.dtype}")
        columns: dict[str, NDArray[Any] | None] = {
            "scale": self.scale,
            "angle": self.angle,
            "response": self.response,
            "laplacian_sign": self.laplacian_sign,
        }
        for name, values in columns.items():
            if values is not None and values.shape != (count,):
                raise ArgumentError(f"{count} points, but {name} of shape {values.shape}")

    def __len__(self) -> int:
        """Number of keypoints."""
        return len(self.points)

    def take(self, index: NDArray[np.intp]) -> Self:
        """The keypoints of the given indices, in their order."""
        return replace(
            self,
            points=self.points[index],
            descriptors=self.descriptors[index],
            scale=self.scale[index],
            angle=self.angle[index],
            response=self.response[index],
            laplacian_sign=None if self.laplacian_sign is None else self.laplacian_sign[index],
        )

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """All keypoints of at least one part; parts are of one kind, and have no signs."""
        return replace(
            parts[0],
            points=np.concatenate([part.points for part in parts]),
            descriptors=np.concatenate([part.descriptors for part in parts]),
            scale=np.concatenate([part.scale for part in parts]),
            angle=np.concatenate([part.angle for part in parts]),
            response=np.concatenate([part.response for part in parts]),
        )

    @property
    def binary(self) -> bool:
        """Whether descriptors are bits, compared by the Hamming distance."""
        return self.descriptors.dtype == np.uint8
