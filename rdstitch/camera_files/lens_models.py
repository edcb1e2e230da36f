"""Lens models of others: Brown's polynomial and Kannala and Brandt's fisheye, and the one nearest to a camera.

Every model is a *forward* map: pixels of a lens without distortion to measured pixels. It is fitted to a camera by
least squares over the image, and what that costs in pixels is stated.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera, points_over

_GRID = 65  # points along each side of the image that models are fitted at
_RATIONAL_STEPS = 12
_NEWTON_STEPS, _NEWTON_TOLERANCE = 20, 1e-10

CLOSE = 0.1
"""Pixels: a model that is nowhere farther from the lens needs no better one in its place."""


@dataclass(frozen=True)
class LensFit:
    """How well a fitted lens model agrees with the one it was fitted to."""

    rms: float  # rms, largest: of the distances between the pixels that both models give, over the whole image, pixels
    largest: float


@dataclass(frozen=True)
class LensModel:
    """A lens as OpenCV has it: Brown's model, with its rational denominator, or the one of ``cv2.fisheye``."""

    focal: tuple[float, float]  # along x and y, pixels
    center: tuple[float, float]  # pixels
    # in OpenCV's order: up to 8 of k1, k2, p1, p2, k3, k4, k5, k6; of a fisheye up to 4 of k1, k2, k3, k4, for which a
    # ray at angle θ from the axis is measured ``f (θ + k1 θ³ + k2 θ⁵ + k3 θ⁷ + k4 θ⁹)`` from the centre
    coefficients: tuple[float, ...]
    fisheye: bool = False

    @property
    def mean_focal(self) -> float:
        """One focal length for both directions, pixels."""
        return float(np.sqrt(self.focal[0] * self.focal[1]))

    def distort(self, points: FloatArray) -> FloatArray:
        """Map pixels (..., 2) of a lens without distortion and with square pixels to measured pixels.

        Beyond the radius at which Brown's polynomial folds, the result has no meaning.
        """
        return self._bend((points - self.center) / self.mean_focal) * self.focal + self.center

    def undistort(self, points: FloatArray) -> FloatArray:
        """Invert :meth:`distort` of Brown's model by Newton's method; NaN where the polynomial folds on the way."""
        target = (points - self.center) / self.focal
        x, step = target.copy(), 1e-30
        for _ in range(_NEWTON_STEPS):
            # Derivatives are the imaginary parts: the model is analytic.
            a, c = np.moveaxis(self._bend(x + np.array([1j * step, 0.0])).imag / step, -1, 0)
            b, d = np.moveaxis(self._bend(x + np.array([0.0, 1j * step])).imag / step, -1, 0)
            determinant = a * d - b * c
            ex, ey = np.moveaxis(target - self._bend(x), -1, 0) / np.where(determinant > 0.0, determinant, np.nan)
            move = np.stack([d * ex - b * ey, a * ey - c * ex], axis=-1)
            x = x + move
            if not np.nanmax(np.abs(move), initial=0.0) > _NEWTON_TOLERANCE:
                break
        return x * self.mean_focal + self.center

    def _bend(self, points: FloatArray) -> FloatArray:
        """Undistorted points (..., 2) to measured ones, both in focal lengths; Brown's also for complex numbers."""
        if self.fisheye:
            radius = np.linalg.norm(points, axis=-1, keepdims=True)
            angle = np.arctan(radius)
            bent = angle * _series(self.coefficients, angle**2)
            bent = np.where(radius > 0.0, bent / np.maximum(radius, 1e-300), 1.0)
            return np.asarray(points * bent)
        k1, k2, p1, p2, k3, *below = (*self.coefficients, *[0.0] * (8 - len(self.coefficients)))
        x, y = np.moveaxis(points, -1, 0)
        r2 = x * x + y * y
        ratio = _series((k1, k2, k3), r2) / _series(below, r2)
        tangential = [2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y]
        return np.asarray(points * ratio[..., None] + np.stack(tangential, axis=-1))


def _series(coefficients: Sequence[float], squares: FloatArray) -> FloatArray:
    """``1 + c1 s + c2 s² + …``."""
    total = np.zeros_like(squares)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * squares
    return 1.0 + total


def least_squares(terms: FloatArray, values: FloatArray) -> FloatArray:
    """Solve ``terms x = values`` by least squares, with columns of one size."""
    size = np.maximum(np.abs(terms).max(axis=0), 1e-300)
    solution: FloatArray = np.linalg.lstsq(terms / size, values, rcond=None)[0] / size
    return solution


@dataclass(frozen=True)
class LensSamples:
    """Radii of points all over what is drawn of an image, N of them."""

    straight: FloatArray  # straight, bent: (N,): from the distortion centre, undistorted and measured, focal lengths
    bent: FloatArray
    focal: float  # pixels; guessed where the camera has none

    @classmethod
    def of(cls, camera: Camera) -> Self:
        """Sample a camera."""
        focal = camera.with_focal().focal
        assert focal is not None
        measured = points_over(camera.image_size, _GRID)
        bent = np.linalg.norm(measured - camera.center, axis=1)
        drawn = bent <= camera.drawn_radius
        straight = np.linalg.norm(camera.undistort(measured[drawn]) - camera.center, axis=1)
        return cls(straight / focal, bent[drawn] / focal, focal)

    def fit(self, start: FloatArray, terms: FloatArray) -> tuple[FloatArray, LensFit]:
        """Find coefficients (K,) for which ``start + terms k`` are the measured radii; ``terms`` of shape (N, K)."""
        coefficients = least_squares(terms, self.bent - start)
        return coefficients, self._compare(start + terms @ coefficients)

    def fit_rational(self) -> tuple[FloatArray, LensFit]:
        """Find coefficients (6,): ``u (1 + k1 u² + k2 u⁴ + k3 u⁶) / (1 + k4 u² + k5 u⁴ + k6 u⁶)`` are the radii.

        Linear least squares, weighted by the denominator of the step before; of all steps the one with the smallest
        error is kept.
        """
        # Radii up to 1, whatever the unit: high powers of large ones are otherwise all that counts.
        size = float(self.straight.max())
        powers = (self.straight[:, None] / size) ** np.array([2, 4, 6])
        terms = np.hstack([self.straight[:, None] * powers, -self.bent[:, None] * powers])
        denominator, fits = np.ones_like(self.bent), [(np.zeros(6), self._compare(self.straight))]
        for _ in range(_RATIONAL_STEPS):
            k = least_squares(terms / denominator[:, None], (self.bent - self.straight) / denominator)
            denominator = 1.0 + powers @ k[3:]
            if not (denominator > 1e-3).all():
                break
            fits.append((k, self._compare(self.straight * (1.0 + powers @ k[:3]) / denominator)))
        coefficients, fit = min(fits, key=lambda found: found[1].largest)
        return coefficients / np.tile(size ** np.array([2.0, 4.0, 6.0]), 2), fit

    def _compare(self, bent: FloatArray) -> LensFit:
        """Compare a model's measured radii (N,) with these."""
        error = np.abs(bent - self.bent) * self.focal
        return LensFit(float(np.sqrt(np.mean(error**2))), float(error.max()))

    def fit_powers(self, powers: Sequence[int], *, fisheye: bool = False) -> tuple[FloatArray, LensFit]:
        """Find coefficients of powers of the undistorted radius, or of its angle, beside that itself."""
        start = np.arctan(self.straight) if fisheye else self.straight
        return self.fit(start, start[:, None] ** np.array(powers))


_FITS: dict[str, tuple[Callable[[LensSamples], tuple[FloatArray, LensFit]], tuple[int | None, ...]]] = {
    "two terms": (lambda samples: samples.fit_powers((3, 5)), (0, 1, None, None)),
    "polynomial": (lambda samples: samples.fit_powers((3, 5, 7)), (0, 1, None, None, 2)),
    "rational": (LensSamples.fit_rational, (0, 1, None, None, 2, 3, 4, 5)),
    "fisheye": (lambda samples: samples.fit_powers((3, 5, 7, 9), fisheye=True), (0, 1, 2, 3)),
}
"""How a model is fitted, and which of the numbers found each of OpenCV's coefficients is; None for 0."""


def nearest_model(camera: Camera, *models: str, close: float = CLOSE) -> tuple[LensModel, LensFit]:
    """Fit lens models of :data:`_FITS` to a camera: the first that is so close, pixels, or else the nearest."""
    samples, found = LensSamples.of(camera), []
    for model in models:
        fit, places = _FITS[model]
        numbers, error = fit(samples)
        coefficients = tuple(0.0 if place is None else float(numbers[place]) for place in places)
        found.append((LensModel((samples.focal,) * 2, camera.center, coefficients, model == "fisheye"), error))
        if error.largest <= close:
            break
    return min(found, key=lambda one: one[1].largest)
