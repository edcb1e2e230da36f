"""Lenses to render with. :class:`rdstitch.geometry.camera.Camera` is one; the others are no division model."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera, border_of
from rdstitch.geometry.lens_model import LensModel

_FISHEYES: dict[str, tuple[Callable[[FloatArray], FloatArray], Callable[[FloatArray], FloatArray]]] = {
    "equidistant": (lambda angle: angle, lambda r: r),
    "equisolid": (lambda angle: 2.0 * np.sin(angle / 2.0), lambda r: 2.0 * np.arcsin(np.minimum(r / 2.0, 1.0))),
    "stereographic": (lambda angle: 2.0 * np.tan(angle / 2.0), lambda r: 2.0 * np.arctan(r / 2.0)),
}
"""Measured radius of the angle to the axis, in focal lengths, and the inverse, of each kind of fisheye."""


@dataclass(frozen=True)
class _FixedFocalLens:
    image_size: tuple[int, int]  # width and height, pixels
    focal: float  # at the centre, pixels
    # from the image centre to the principal point, pixels
    offset: tuple[float, float] = field(default=(0.0, 0.0), kw_only=True)

    @property
    def center(self) -> tuple[float, float]:
        """Principal point, pixels."""
        return (self.image_size[0] - 1) / 2 + self.offset[0], (self.image_size[1] - 1) / 2 + self.offset[1]

    def _normalize(self, points: ArrayLike) -> FloatArray:
        return (np.asarray(points, dtype=np.float64) - self.center) / self.focal

    def _denormalize(self, points: FloatArray) -> FloatArray:
        return points * self.focal + self.center

    def outline(self, points_per_side: int) -> FloatArray:
        """Outer border of the image, clockwise, pixels (4 points_per_side, 2)."""
        return border_of(self.image_size, points_per_side)


@dataclass(frozen=True)
class FisheyeLens(_FixedFocalLens):
    """A fisheye: the angle θ of a ray to the axis alone says how far from the centre it is measured.

    ``kind`` is "equidistant" (``focal * θ``), "equisolid" (``2 focal sin(θ/2)``) or "stereographic" (``2 focal
    tan(θ/2)``); beyond the radius ``image_circle`` about the centre, pixels, the image is black.
    """

    kind: str = field(default="equidistant", kw_only=True)
    image_circle: float = field(default=math.inf, kw_only=True)

    def __post_init__(self) -> None:
        if self.kind not in _FISHEYES:
            raise ArgumentError(f"a fisheye is {', '.join(_FISHEYES)}, not {self.kind}")

    def undistort(self, points: ArrayLike) -> FloatArray:
        """Measured pixels to pinhole pixels; NaN for rays at 90° and more, and beyond the image circle."""
        x = self._normalize(points)
        radius = np.linalg.norm(x, axis=-1, keepdims=True)
        angle = _FISHEYES[self.kind][1](radius)
        drawn = (angle < np.pi / 2) & (radius <= self.image_circle / self.focal * (1.0 + 1e-9))
        tangent = np.tan(np.where(drawn, angle, np.nan))
        return self._denormalize(x * np.where(radius > 0.0, tangent / np.maximum(radius, 1e-300), 1.0))

    def distort(self, points: ArrayLike) -> FloatArray:
        """Pinhole pixels to measured pixels."""
        x = self._normalize(points)
        tangent = np.linalg.norm(x, axis=-1, keepdims=True)
        radius = _FISHEYES[self.kind][0](np.arctan(tangent))
        return self._denormalize(x * np.where(tangent > 0.0, radius / np.maximum(tangent, 1e-300), 1.0))

    def outline(self, points_per_side: int) -> FloatArray:
        """Outer border of the image, or of its circle, clockwise, pixels (4 points_per_side, 2)."""
        offset = super().outline(points_per_side) - self.center
        radius = np.linalg.norm(offset, axis=1, keepdims=True)
        return np.asarray(self.center + offset * np.minimum(1.0, self.image_circle / radius))


@dataclass(frozen=True)
class BrownLens(_FixedFocalLens):
    """OpenCV's polynomial of Brown: ``x_d = x_u (1 + k1 r² + k2 r⁴ + k3 r⁶) + tangential part``, ``r = |x_u|``."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @property
    def _model(self) -> LensModel:
        return LensModel((self.focal,) * 2, self.center, (self.k1, self.k2, self.p1, self.p2, self.k3))

    def distort(self, points: ArrayLike) -> FloatArray:
        """Pinhole pixels to measured pixels; where the polynomial has folded, the result has no meaning."""
        return self._model.distort(np.asarray(points, dtype=np.float64))

    def undistort(self, points: ArrayLike) -> FloatArray:
        """Measured pixels to pinhole pixels; NaN where the polynomial folds."""
        return self._model.undistort(np.asarray(points, dtype=np.float64))


Lens = Camera | FisheyeLens | BrownLens
"""A lens to render with; a camera needs a focal length."""


def focal_length(lens: Lens) -> float:
    """Focal length of a lens, pixels."""
    if lens.focal is None:
        raise ArgumentError("a camera needs a focal length before anything can be rendered with it")
    return lens.focal
