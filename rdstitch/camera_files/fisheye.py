"""Kannala and Brandt's fisheye model, as OpenCV, ROS, Kalibr and COLMAP have it: a polynomial of the angle."""

from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.camera_files.lens_fit import LensFit, LensSamples


@dataclass(frozen=True)
class Fisheye:
    """A lens that measures a ray at angle θ from the axis ``f (θ + k1 θ³ + k2 θ⁵ + k3 θ⁷ + k4 θ⁹)`` from the centre.

    Attributes
    ----------
    focal : (float, float)
        Along x and y, pixels.
    center : (float, float)
        Pixels.
    coefficients : tuple of float
        k1, k2, k3, k4.
    """

    focal: tuple[float, float]
    center: tuple[float, float]
    coefficients: tuple[float, ...]

    @property
    def mean_focal(self) -> float:
        """One focal length for both directions, pixels."""
        return float(np.sqrt(self.focal[0] * self.focal[1]))

    def distort(self, points: FloatArray) -> FloatArray:
        """Pixels (..., 2) of a lens without distortion and with square pixels to measured pixels."""
        x = (points - self.center) / self.mean_focal
        radius = np.linalg.norm(x, axis=-1)
        angle = np.arctan(radius)
        bent = angle * (1.0 + sum(k * angle ** (2 * i) for i, k in enumerate(self.coefficients, start=1)))
        ratio = np.where(radius > 0.0, bent / np.maximum(radius, 1e-300), 1.0)
        return x * ratio[..., None] * self.focal + self.center


def fisheye_of(camera: Camera) -> tuple[Fisheye, LensFit]:
    """The fisheye model of a camera by least squares; the focal length is guessed where it is not known."""
    focal = camera.with_focal().focal
    assert focal is not None
    samples = LensSamples.of(camera, focal)
    angle = np.arctan(samples.straight)
    coefficients, fit = samples.fit(angle, angle[:, None] ** np.array([3, 5, 7, 9]))
    return Fisheye((focal, focal), camera.center, tuple(coefficients.tolist())), fit
