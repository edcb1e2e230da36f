"""From one lens model to another, by least squares over the image, with what that costs in pixels.

Every model is a *forward* map: pixels of a lens without distortion to measured pixels. The division model is fitted to
others so that the measured pixels agree; others are fitted to the division model in the same way.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera, points_over
from rdstitch.errors import ArgumentError

Forward = Callable[[FloatArray], FloatArray]

_GRID = 65  # points along each side of the image that polynomials are fitted at
_RATIONAL_STEPS, _DIVISION_STEPS = 12, 8
_EXACT_ERROR = 0.1  # pixels: as exactly as a lens can be described at all
_MAX_ERROR = 0.1  # half diagonals: then the file is no lens of these images
_RAYS, _STEPS, _REACH = 64, 1200, 8.0  # where other models are looked at: directions, steps, half diagonals


@dataclass(frozen=True)
class LensFit:
    """How well a fitted lens model agrees with the one it was fitted to.

    Attributes
    ----------
    rms, largest : float
        Of the distances between the pixels that both models give, over the whole image, pixels.
    """

    rms: float
    largest: float


@dataclass(frozen=True)
class LensSamples:
    """Radii of points all over what is drawn of an image, N of them.

    Attributes
    ----------
    straight, bent : ndarray of shape (N,)
        From the distortion centre, undistorted and measured, focal lengths.
    focal : float
        Pixels; guessed where the camera has none.
    """

    straight: FloatArray
    bent: FloatArray
    focal: float

    @classmethod
    def of(cls, camera: Camera) -> Self:
        """Of a camera."""
        focal = camera.with_focal().focal
        assert focal is not None
        measured = points_over(camera.image_size, _GRID)
        measured = measured[np.linalg.norm(measured - camera.center, axis=1) <= camera.drawn_radius]
        straight = np.linalg.norm(camera.undistort(measured) - camera.center, axis=1) / focal
        return cls(straight, np.linalg.norm(measured - camera.center, axis=1) / focal, focal)

    def fit(self, start: FloatArray, terms: FloatArray) -> tuple[FloatArray, LensFit]:
        """Coefficients (K,) for which ``start + terms k`` are the measured radii; ``terms`` of shape (N, K)."""
        coefficients = _least_squares(terms, self.bent - start)
        return coefficients, self.compare(start + terms @ coefficients)

    def fit_rational(self) -> tuple[FloatArray, LensFit]:
        """Coefficients (6,) for which ``u (1 + k1 u² + k2 u⁴ + k3 u⁶) / (1 + k4 u² + k5 u⁴ + k6 u⁶)`` are the radii.

        Linear least squares, weighted by the denominator of the step before; of all steps the one with the smallest
        error is kept.
        """
        # Radii up to 1, whatever the unit: high powers of large ones are otherwise all that counts.
        size = float(self.straight.max())
        powers = (self.straight[:, None] / size) ** np.array([2, 4, 6])
        terms = np.hstack([self.straight[:, None] * powers, -self.bent[:, None] * powers])
        denominator, fits = np.ones_like(self.bent), []
        for _ in range(_RATIONAL_STEPS):
            k = _least_squares(terms / denominator[:, None], (self.bent - self.straight) / denominator)
            denominator = 1.0 + powers @ k[3:]
            if not (denominator > 1e-3).all():
                break
            fits.append((k, self.compare(self.straight * (1.0 + powers @ k[:3]) / denominator)))
        if not fits:
            return np.zeros(6), self.compare(self.straight)
        coefficients, fit = min(fits, key=lambda found: found[1].largest)
        return coefficients / np.tile(size ** np.array([2.0, 4.0, 6.0]), 2), fit

    def compare(self, bent: FloatArray) -> LensFit:
        """How far a model's measured radii (N,) are from these."""
        error = np.abs(bent - self.bent) * self.focal
        return LensFit(float(np.sqrt(np.mean(error**2))), float(error.max()))


def _least_squares(terms: FloatArray, values: FloatArray) -> FloatArray:
    """Least squares with columns of one size."""
    size = np.maximum(np.abs(terms).max(axis=0), 1e-300)
    solution: FloatArray = np.linalg.lstsq(terms / size, values, rcond=None)[0] / size
    return solution


def fit_lens(forward: Forward, camera: Camera) -> tuple[Camera, LensFit]:
    """Fit the division model to another lens model: with λ alone where that is enough, else with μ, else with ν too.

    Parameters
    ----------
    forward : callable
        The other model: pixels without distortion (N, 2) to measured pixels (N, 2).
    camera : Camera
        Size, distortion centre and focal length.

    Returns
    -------
    Camera, LensFit
        The camera with the lens, and what it costs.

    Raises
    ------
    ArgumentError
        When the other model folds the image, or is far from every division model.
    """
    straight, measured, weights = _rays(forward, camera)
    flat, bent = camera.normalize(straight), camera.normalize(measured)
    radius = np.linalg.norm(bent, axis=1)
    # A lens without distortion is what a model that is off centre or tangential would otherwise be fitted to.
    ratio = np.einsum("ij,ij->i", flat, bent) / np.maximum(radius**2, 1e-300)
    best: tuple[Camera, LensFit] | None = None
    for count in (1, 2, 3):
        coefficients = _fit_divisor(radius**2, 1.0 / ratio, weights, count)
        try:
            lens = camera.with_coefficients(*coefficients)
        except ArgumentError:
            continue
        error = np.linalg.norm(lens.distort(straight) - measured, axis=1)
        if not np.isfinite(error).all():
            continue
        fit = LensFit(float(np.sqrt(weights @ error**2 / weights.sum())), float(error.max()))
        if best is None or fit.largest < 0.5 * best[1].largest:
            best = lens, fit
        if best[1].largest <= _EXACT_ERROR:
            break
    if best is None or best[1].largest > _MAX_ERROR * camera.half_diagonal:
        raise ArgumentError("the lens is far from every lens that the division model can describe")
    return best


def _fit_divisor(radius2: FloatArray, divisor: FloatArray, weights: FloatArray, count: int) -> list[float]:
    """``count`` coefficients of ``g`` for which undistorted radii give the measured ones, by weighted least squares."""
    terms = radius2[:, None] ** np.arange(1, count + 1)
    found = np.zeros(count)
    for _ in range(_DIVISION_STEPS):
        # An error of g moves the measured radius by r / (g - 2 q g').
        slope = divisor - 2.0 * terms @ (np.arange(1, count + 1) * found)
        weight = np.sqrt(weights * radius2) / np.maximum(slope, 1e-2)
        found = _least_squares(weight[:, None] * terms, weight * (divisor - 1.0))
    return found.tolist()


def _rays(forward: Forward, camera: Camera) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points along rays from the centre to the border of the measured image: straight, measured, and their areas."""
    angles = np.arange(_RAYS) * (2.0 * np.pi / _RAYS)
    radii = np.linspace(0.0, _REACH * camera.half_diagonal, _STEPS + 1)[1:]
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None] * radii[None, :, None] + camera.center
    with np.errstate(all="ignore"):
        measured = forward(rays.reshape(-1, 2)).reshape(rays.shape)
        distance = np.linalg.norm(measured - camera.center, axis=2)
        steps = np.diff(distance, axis=1, prepend=0.0)
    within = (measured > -0.5) & (measured < np.array(camera.image_size) - 0.5)
    inside = within[..., 0] & within[..., 1]
    # Along each ray, what comes before it leaves the image for the first time; with a fisheye of 180 degrees and
    # more it never does, and of what is near the horizon there is no need to know.
    leaves = np.where(inside.all(axis=1), _STEPS, np.argmin(inside, axis=1))
    seen = np.arange(_STEPS) < leaves[:, None]
    if not inside[:, 0].all() or not (steps[seen] > 0.0).all():
        raise ArgumentError("the lens model folds the image; it does not belong to images of this size")
    return rays[seen], measured[seen], (distance * steps)[seen]
