"""Lenses to render with. :class:`rdstitch.camera.Camera` is one; the others are no division model."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.errors import ArgumentError

_NEWTON_STEPS = 20
_TOLERANCE = 1e-10


class Lens(Protocol):
    """What rendering needs of a lens; :class:`Camera` with a focal length fulfils it."""

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height, pixels."""

    @property
    def center(self) -> tuple[float, float]:
        """Principal point, pixels."""

    @property
    def focal(self) -> float | None:
        """Focal length at the centre, pixels."""

    def undistort(self, points: ArrayLike) -> FloatArray:
        """Measured pixels (..., 2) to pixels of a pinhole camera with the same focal length and centre, or NaN."""

    def distort(self, points: ArrayLike) -> FloatArray:
        """The inverse of :meth:`undistort`."""


@dataclass(frozen=True)
class _FixedFocalLens:
    """A lens with a focal length and a principal point.

    Attributes
    ----------
    image_size : (int, int)
        Width and height, pixels.
    focal : float
        Focal length at the centre, pixels.
    offset : (float, float)
        From the image centre to the principal point, pixels.
    """

    image_size: tuple[int, int]
    focal: float
    offset: tuple[float, float] = field(default=(0.0, 0.0), kw_only=True)

    @property
    def center(self) -> tuple[float, float]:
        """Principal point, pixels."""
        return (self.image_size[0] - 1) / 2 + self.offset[0], (self.image_size[1] - 1) / 2 + self.offset[1]

    def _normalize(self, points: ArrayLike) -> FloatArray:
        return (np.asarray(points, dtype=np.float64) - self.center) / self.focal

    def _denormalize(self, points: FloatArray) -> FloatArray:
        return points * self.focal + self.center


@dataclass(frozen=True)
class FisheyeLens(_FixedFocalLens):
    """Equidistant fisheye: a ray at angle θ from the axis is measured ``focal * θ`` from the centre."""

    def undistort(self, points: ArrayLike) -> FloatArray:
        """Measured pixels to pinhole pixels; NaN for rays at 90° and more."""
        x = self._normalize(points)
        angle = np.linalg.norm(x, axis=-1, keepdims=True)
        inside = np.where(angle < np.pi / 2, angle, np.nan)
        return self._denormalize(x * np.tan(inside) / np.where(angle > 0.0, angle, 1.0) + x * (angle == 0.0))

    def distort(self, points: ArrayLike) -> FloatArray:
        """Pinhole pixels to measured pixels."""
        x = self._normalize(points)
        radius = np.linalg.norm(x, axis=-1, keepdims=True)
        return self._denormalize(x * np.where(radius > 0.0, np.arctan(radius) / np.maximum(radius, 1e-300), 1.0))


@dataclass(frozen=True)
class BrownLens(_FixedFocalLens):
    """Brown's polynomial, OpenCV's model: ``x_d = x_u (1 + k1 r² + k2 r⁴ + k3 r⁶) + tangential part``, ``r = |x_u|``.

    Attributes
    ----------
    k1, k2, k3 : float
        Radial coefficients, focal-normalized.
    p1, p2 : float
        Tangential coefficients.
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def distort(self, points: ArrayLike) -> FloatArray:
        """Pinhole px to measured px. Beyond the radius where the polynomial folds, the result has no meaning."""
        return self._denormalize(self._forward(self._normalize(points))[0])

    def undistort(self, points: ArrayLike) -> FloatArray:
        """Measured px to pinhole px by Newton's method; NaN where it does not converge or the polynomial folds."""
        target = self._normalize(points)
        x = target.copy()
        for _ in range(_NEWTON_STEPS):
            value, jacobian = self._forward(x)
            determinant = np.linalg.det(jacobian)
            adjugate = np.stack(
                [
                    np.stack([jacobian[..., 1, 1], -jacobian[..., 0, 1]], axis=-1),
                    np.stack([-jacobian[..., 1, 0], jacobian[..., 0, 0]], axis=-1),
                ],
                axis=-2,
            )
            step = np.einsum("...ij,...j->...i", adjugate, target - value)
            x = x + step / np.where(determinant > 0.0, determinant, np.nan)[..., None]
            if not np.nanmax(np.abs(step), initial=0.0) > _TOLERANCE:
                break
        return self._denormalize(x)

    def _forward(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distorted points (..., 2) and the derivative (..., 2, 2) by the undistorted ones, focal-normalized."""
        u, v = x[..., 0], x[..., 1]
        r2 = u * u + v * v
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        slope = 2.0 * (self.k1 + r2 * (2.0 * self.k2 + r2 * 3.0 * self.k3))
        du = u * radial + 2.0 * self.p1 * u * v + self.p2 * (r2 + 2.0 * u * u)
        dv = v * radial + 2.0 * self.p2 * u * v + self.p1 * (r2 + 2.0 * v * v)
        uu = radial + slope * u * u + 2.0 * self.p1 * v + 6.0 * self.p2 * u
        vv = radial + slope * v * v + 2.0 * self.p2 * u + 6.0 * self.p1 * v
        uv = slope * u * v + 2.0 * self.p1 * u + 2.0 * self.p2 * v
        jacobian = np.stack([np.stack([uu, uv], axis=-1), np.stack([uv, vv], axis=-1)], axis=-2)
        return np.stack([du, dv], axis=-1), jacobian


def focal_length(lens: Lens) -> float:
    """Focal length of a lens, pixels.

    Raises
    ------
    ArgumentError
        When it is not known: nothing can be rendered without it.
    """
    if lens.focal is None:
        raise ArgumentError("a camera needs a focal length before anything can be rendered with it")
    return lens.focal


def best_division_model(lens: Lens, samples: int = 400) -> tuple[Camera, float]:
    """The division model nearest to a lens, and how far it is from it.

    λ minimises the distance in measured pixels between the two lenses, over the same pinhole rays evenly spread in the
    picture's radius up to its corners, up to the focal length, which is free.

    Returns
    -------
    camera : Camera
    rms : float
        What is left, pixels.
    """
    # Imported late: rendering, which needs the lenses, should not wait for SciPy's optimizers.
    from scipy.optimize import least_squares

    width, height = lens.image_size
    corner = np.array([width - 0.5, height - 0.5])
    center, f = np.array(lens.center), focal_length(lens)
    measured = center + np.sqrt(np.linspace(0.0, 1.0, samples))[:, None] * (corner - center)
    pinhole = lens.undistort(measured) - center
    seen = np.isfinite(pinhole).all(axis=1)

    def camera(distortion: float, scale: float) -> Camera:
        return Camera(lens.image_size, float(distortion), center=lens.center, focal=f * float(scale))

    def residual(parameters: FloatArray) -> FloatArray:
        model = camera(*parameters)
        offset: FloatArray = model.distort(center + parameters[1] * pinhole[seen]) - measured[seen]
        return offset.ravel()

    fit = least_squares(residual, [-0.05, 1.0], bounds=([-0.95, 0.3], [0.9, 3.0]))
    return camera(*fit.x), float(np.sqrt(2.0 * np.mean(fit.fun**2)))
