"""Lens models of others that several formats share: Brown's polynomial, and Kannala and Brandt's fisheye."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.camera_files.lens_fit import LensFit, LensSamples

_POWERS = (3, 5, 7)
_NEWTON_STEPS, _NEWTON_TOLERANCE = 20, 1e-10

CLOSE = 0.1
"""Pixels: a model that is nowhere farther from the lens needs no better one in its place."""


@dataclass(frozen=True)
class ForeignLens(ABC):
    """What both models have.

    Attributes
    ----------
    focal : (float, float)
        Along x and y, pixels.
    center : (float, float)
        Pixels.
    """

    focal: tuple[float, float]
    center: tuple[float, float]

    @abstractmethod
    def distort(self, points: FloatArray) -> FloatArray:
        """Pixels (..., 2) of a lens without distortion and with square pixels to measured pixels."""

    @property
    def mean_focal(self) -> float:
        """One focal length for both directions, pixels."""
        return float(np.sqrt(self.focal[0] * self.focal[1]))


@dataclass(frozen=True)
class Brown(ForeignLens):
    """Brown's model, a polynomial of the undistorted radius in focal lengths, with OpenCV's rational denominator.

    Attributes
    ----------
    radial : tuple of float
        k1, k2, k3.
    tangential : (float, float)
        p1, p2.
    denominator : tuple of float
        k4, k5, k6.
    """

    radial: tuple[float, ...]
    tangential: tuple[float, float] = (0.0, 0.0)
    denominator: tuple[float, ...] = ()

    @classmethod
    def of_opencv(cls, focal: tuple[float, float], center: tuple[float, float], coefficients: Sequence[float]) -> Self:
        """From up to 8 coefficients in OpenCV's order: k1, k2, p1, p2, k3, k4, k5, k6."""
        k1, k2, p1, p2, k3, *denominator = (*coefficients, *[0.0] * (8 - len(coefficients)))
        return cls(focal, center, (k1, k2, k3), (p1, p2), tuple(denominator))

    def distort(self, points: FloatArray) -> FloatArray:
        """Pixels (..., 2) of a lens without distortion and with square pixels to measured pixels.

        Beyond the radius at which the polynomial folds, the result has no meaning.
        """
        return self._forward((points - self.center) / self.mean_focal)[0] * self.focal + self.center

    def undistort(self, points: FloatArray) -> FloatArray:
        """The inverse of :meth:`distort` by Newton's method; NaN where the polynomial folds on the way."""
        target = (points - self.center) / self.focal
        x = target.copy()
        for _ in range(_NEWTON_STEPS):
            value, jacobian = self._forward(x)
            (a, b), (c, d) = np.moveaxis(jacobian, (-2, -1), (0, 1))
            determinant = a * d - b * c
            ex, ey = np.moveaxis(target - value, -1, 0) / np.where(determinant > 0.0, determinant, np.nan)
            step = np.stack([d * ex - b * ey, a * ey - c * ex], axis=-1)
            x = x + step
            if not np.nanmax(np.abs(step), initial=0.0) > _NEWTON_TOLERANCE:
                break
        return x * self.mean_focal + self.center

    def _forward(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distorted points (..., 2) and their derivatives (..., 2, 2) by the undistorted ones, focal-normalized."""
        x, y = np.moveaxis(points, -1, 0)
        r2 = x * x + y * y
        above, below = _series(self.radial, r2), _series(self.denominator, r2)
        ratio = above / below
        slope = 2.0 * (_series_slope(self.radial, r2) - ratio * _series_slope(self.denominator, r2)) / below
        p1, p2 = self.tangential
        bent_x = x * ratio + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        bent_y = y * ratio + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        xx = ratio + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        yy = ratio + slope * y * y + 2.0 * p2 * x + 6.0 * p1 * y
        xy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        jacobian = np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-2)
        return np.stack([bent_x, bent_y], axis=-1), jacobian


@dataclass(frozen=True)
class Fisheye(ForeignLens):
    """A lens that measures a ray at angle θ from the axis ``f (θ + k1 θ³ + k2 θ⁵ + k3 θ⁷ + k4 θ⁹)`` from the centre.

    Attributes
    ----------
    coefficients : tuple of float
        k1, k2, k3, k4.
    """

    coefficients: tuple[float, ...]

    def distort(self, points: FloatArray) -> FloatArray:
        """Pixels (..., 2) of a lens without distortion and with square pixels to measured pixels."""
        x = (points - self.center) / self.mean_focal
        radius = np.linalg.norm(x, axis=-1)
        angle = np.arctan(radius)
        bent = angle * (1.0 + sum(k * angle ** (2 * i) for i, k in enumerate(self.coefficients, start=1)))
        ratio = np.where(radius > 0.0, bent / np.maximum(radius, 1e-300), 1.0)
        return x * ratio[..., None] * self.focal + self.center


def brown_of(camera: Camera, terms: int = 3) -> tuple[Brown, LensFit]:
    """Brown's model of a camera by least squares, with the first ``terms`` of k1, k2, k3."""
    samples = LensSamples.of(camera)
    radial, fit = samples.fit(samples.straight, samples.straight[:, None] ** np.array(_POWERS[:terms]))
    return Brown((samples.focal,) * 2, camera.center, (*radial.tolist(), *[0.0] * (3 - terms))), fit


def rational_of(camera: Camera) -> tuple[Brown, LensFit]:
    """OpenCV's rational model of a camera: Brown's with a denominator, which also describes strong lenses."""
    samples = LensSamples.of(camera)
    found, fit = samples.fit_rational()
    return Brown(
        (samples.focal,) * 2, camera.center, tuple(found[:3].tolist()), denominator=tuple(found[3:].tolist())
    ), fit


def least_brown_of(camera: Camera) -> tuple[Brown, LensFit]:
    """Brown's polynomial where that is close to the lens, else the rational model."""
    plain = brown_of(camera)
    if plain[1].largest <= CLOSE:
        return plain
    return min(plain, rational_of(camera), key=lambda found: found[1].largest)


def fisheye_of(camera: Camera) -> tuple[Fisheye, LensFit]:
    """The fisheye model of a camera by least squares."""
    samples = LensSamples.of(camera)
    angle = np.arctan(samples.straight)
    coefficients, fit = samples.fit(angle, angle[:, None] ** np.array([3, 5, 7, 9]))
    return Fisheye((samples.focal,) * 2, camera.center, tuple(coefficients.tolist())), fit


def closer_fisheye(camera: Camera, other: LensFit, close: float = CLOSE) -> tuple[Fisheye, LensFit] | None:
    """The fisheye model of a camera, if another one is not close enough (pixels) to the lens and this one is closer."""
    if other.largest <= close:
        return None
    fisheye, fit = fisheye_of(camera)
    return (fisheye, fit) if fit.largest < other.largest else None


def _series(coefficients: tuple[float, ...], r2: FloatArray) -> FloatArray:
    """``1 + c1 r² + c2 r⁴ + …``."""
    total = np.zeros_like(r2)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * r2
    return 1.0 + total


def _series_slope(coefficients: tuple[float, ...], r2: FloatArray) -> FloatArray:
    """Derivative of :func:`_series` by ``r²``."""
    total = np.zeros_like(r2)
    for power in range(len(coefficients), 0, -1):
        total = total * r2 + power * coefficients[power - 1]
    return total
