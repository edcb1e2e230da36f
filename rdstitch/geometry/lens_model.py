"""Lens models of other programs, as their calibrations give them.

Each is a *forward* map: pixels of a lens without distortion and with square pixels to measured pixels. It goes with a
:class:`rdstitch.geometry.camera.Camera` whose coefficients come close to it.
"""

from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.geometry.division_model import horner

_NEWTON_STEPS = 20
_NEWTON_TOLERANCE = 1e-10

LensKind = Literal["brown", "fisheye", "polynomial", "fisheye polynomial"]


@dataclass(frozen=True)
class LensModel:
    """A lens as OpenCV, Hugin or lensfun has it."""

    focal: tuple[float, float]  # along x and y, pixels
    center: tuple[float, float]  # pixels
    # "brown": up to 8 of OpenCV's k1, k2, p1, p2, k3, k4, k5, k6. "fisheye", that of ``cv2.fisheye``: up to 4 of
    # k1, k2, k3, k4, for which a ray at angle θ from the axis is measured ``f (θ + k1 θ³ + k2 θ⁵ + k3 θ⁷ + k4 θ⁹)``
    # from the centre. "polynomial": ``f (r + c1 r² + c2 r³ + …)``; "fisheye polynomial": the same of θ
    coefficients: tuple[float, ...]
    kind: LensKind = "brown"

    @property
    def fisheye(self) -> bool:
        """Whether it is that of ``cv2.fisheye``."""
        return self.kind == "fisheye"

    @property
    def mean_focal(self) -> float:
        """One focal length for both directions, pixels."""
        return float(np.sqrt(self.focal[0] * self.focal[1]))

    def resized(self, factor: float, center: tuple[float, float]) -> Self:
        """The same lens on an image of another size."""
        return replace(self, focal=(self.focal[0] * factor, self.focal[1] * factor), center=center)

    def turned(self, matrix: FloatArray, center: tuple[float, float]) -> Self:
        """The same lens on an image that was turned or mirrored by a matrix (2, 2) of 0, 1 and -1."""
        fx, fy = np.abs(matrix) @ np.array(self.focal)
        k = self.coefficients
        if self.kind == "brown" and any(k[2:4]):
            # The tangential terms are 2 (p · x) x + r² p with p = (p2, p1).
            p2, p1 = (matrix @ np.array([k[3] if len(k) > 3 else 0.0, k[2]])).tolist()
            k = (*k[:2], p1, p2, *k[4:])
        return replace(self, focal=(float(fx), float(fy)), center=center, coefficients=k)

    def distort(self, points: FloatArray) -> FloatArray:
        """Map pixels (..., 2) of a lens without distortion and with square pixels to measured pixels.

        Beyond the radius at which Brown's polynomial folds, the result has no meaning.
        """
        return self._bend((points - self.center) / self.mean_focal) * self.focal + self.center

    def undistort(self, points: FloatArray) -> FloatArray:
        """Invert :meth:`distort` by Newton's method; NaN where that does not converge, or where the lens folds."""
        target = (points - self.center) / self.focal
        x, step = target.copy(), 1e-30
        with np.errstate(all="ignore"):  # of points that diverge
            for _ in range(_NEWTON_STEPS):
                # Derivatives are the imaginary parts: the model is analytic.
                a, c = np.moveaxis(self._bend(x + np.array([1j * step, 0.0])).imag / step, -1, 0)
                b, d = np.moveaxis(self._bend(x + np.array([0.0, 1j * step])).imag / step, -1, 0)
                determinant = a * d - b * c
                ex, ey = np.moveaxis(target - self._bend(x), -1, 0) / np.where(determinant > 0.0, determinant, np.nan)
                move = np.stack([d * ex - b * ey, a * ey - c * ex], axis=-1)
                x = x + move
                converged = np.abs(move).max(axis=-1, keepdims=True) <= _NEWTON_TOLERANCE
                if (converged | np.isnan(move[..., :1])).all():
                    break
        return np.where(converged, x, np.nan) * self.mean_focal + self.center

    def _bend(self, points: FloatArray) -> FloatArray:
        """Undistorted points (..., 2) to measured ones, both in focal lengths; analytic, so also of complex numbers."""
        if self.kind != "brown":
            radius = np.sqrt((points * points).sum(axis=-1, keepdims=True))
            ideal = radius if self.kind == "polynomial" else np.arctan(radius)
            bent = ideal * (1.0 + horner(self.coefficients, ideal**2 if self.fisheye else ideal))
            inside = radius == 0.0
            return np.asarray(points * np.where(inside, 1.0, bent / np.where(inside, 1.0, radius)))
        k1, k2, p1, p2, k3, *below = (*self.coefficients, *[0.0] * (8 - len(self.coefficients)))
        x, y = np.moveaxis(points, -1, 0)
        r2 = x * x + y * y
        ratio = np.asarray((1.0 + horner((k1, k2, k3), r2)) / (1.0 + horner(below, r2)))
        tangential = [2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y]
        return np.asarray(points * ratio[..., None] + np.stack(tangential, axis=-1))
