"""Brown's lens model, as OpenCV and OpenDroneMap have it: a polynomial of the undistorted radius, in focal lengths."""

from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.camera_files.lens_fit import LensFit, LensSamples, fit_polynomial

_POWERS = (3, 5, 7)

CLOSE = 0.1
"""Pixels: a model that is nowhere farther from the lens needs no better one in its place."""


@dataclass(frozen=True)
class Brown:
    """A lens of Brown's model with the denominator of OpenCV's rational one.

    Attributes
    ----------
    focal : (float, float)
        Along x and y, pixels.
    center : (float, float)
        pixels.
    radial : tuple of float
        k1, k2, k3.
    tangential : (float, float)
        p1, p2.
    denominator : tuple of float
        k4, k5, k6.
    """

    focal: tuple[float, float]
    center: tuple[float, float]
    radial: tuple[float, ...]
    tangential: tuple[float, float] = (0.0, 0.0)
    denominator: tuple[float, ...] = ()

    @property
    def mean_focal(self) -> float:
        """One focal length for both directions, pixels."""
        return float(np.sqrt(self.focal[0] * self.focal[1]))

    def distort(self, points: FloatArray) -> FloatArray:
        """Px (N, 2) of a lens without distortion and with square pixels to measured pixels."""
        x, y = ((points - self.center) / self.mean_focal).T
        r2 = x * x + y * y
        ratio = _series(self.radial, r2) / _series(self.denominator, r2)
        p1, p2 = self.tangential
        bent_x = x * ratio + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        bent_y = y * ratio + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        return np.stack([bent_x, bent_y], axis=1) * self.focal + self.center


def brown_of(camera: Camera, terms: int = 3) -> tuple[Brown, LensFit]:
    """Brown's model of a camera by least squares; the focal length is guessed where it is not known.

    Parameters
    ----------
    camera : Camera
    terms : int
        How many of k1, k2, k3 the format has.
    """
    focal = camera.with_focal().focal
    assert focal is not None
    radial, fit = fit_polynomial(camera, focal, _POWERS[:terms])
    return Brown((focal, focal), camera.center, (*radial.tolist(), *[0.0] * (3 - terms))), fit


def rational_of(camera: Camera) -> tuple[Brown, LensFit]:
    """OpenCV's rational model of a camera: Brown's with a denominator, which also describes strong lenses."""
    focal = camera.with_focal().focal
    assert focal is not None
    found, fit = LensSamples.of(camera, focal).fit_rational()
    return Brown((focal, focal), camera.center, tuple(found[:3].tolist()), denominator=tuple(found[3:].tolist())), fit


def least_brown_of(camera: Camera) -> tuple[Brown, LensFit]:
    """Brown's polynomial where that is close to the lens, else the rational model."""
    plain = brown_of(camera)
    if plain[1].largest <= CLOSE:
        return plain
    return min(plain, rational_of(camera), key=lambda found: found[1].largest)


def _series(coefficients: tuple[float, ...], r2: FloatArray) -> FloatArray:
    """``1 + c1 r² + c2 r⁴ + …``."""
    total = np.zeros_like(r2)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * r2
    return 1.0 + total
