"""Lens models of others, Brown's polynomial and Kannala and Brandt's fisheye: the nearest to a camera, and back.

A lens model is fitted to a camera, and the division model to it, by least squares over the image, and what that costs
in pixels is stated. The division model has λ alone where that is enough, else μ too, else ν too; what is left goes with
the camera, whose images are resampled by it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.geometry.camera import Camera, points_over
from rdstitch.geometry.lens_model import LensKind, LensModel

_GRID = 65  # points along each side of the image that models are fitted at
_RATIONAL_STEPS = 12

Forward = Callable[[FloatArray], FloatArray]

_STEPS = 8
_MAX_ERROR = 0.1  # half diagonals: then the file is no lens of these images
_RAYS, _SAMPLES, _REACH = 64, 1200, 8.0  # where other models are looked at: directions, steps, half diagonals
_RESOLVED = 1.0 / 32.0  # pixels: what OpenCV resamples images to

CLOSE = 0.1  # pixels: a model that is nowhere farther from a lens needs no better one in its place


@dataclass(frozen=True)
class LensFit:
    """How well a fitted lens model agrees with the one it was fitted to."""

    rms: float  # rms, largest: of the distances between the pixels that both models give, over the whole image, pixels
    largest: float


def _least_squares(terms: FloatArray, values: FloatArray) -> FloatArray:
    """Solve ``terms x = values`` by least squares, with columns of one size."""
    size = np.maximum(np.abs(terms).max(axis=0), 1e-300)
    return np.asarray(np.linalg.lstsq(terms / size, values, rcond=None)[0] / size)


@dataclass(frozen=True, eq=False)
class LensSamples:
    """N points all over what is drawn of an image, and how the radii of models that are fitted must be there."""

    pinhole: FloatArray  # (N, 2): where a lens without distortion shows them, pixels
    measured: FloatArray  # (N, 2): where the lens does
    undistorted: FloatArray  # (N,): radii of ``pinhole``, from the distortion centre, focal lengths
    distorted: FloatArray  # (N,): the same of ``measured`` along these directions, without what the model has besides

    @classmethod
    def of(cls, camera: Camera, base: LensModel) -> Self:
        """Sample a camera for models with the focal lengths, centre and tangential terms of ``base``."""
        measured = points_over(camera.image_size, _GRID)
        measured = measured[np.linalg.norm(measured - camera.center, axis=1) <= camera.drawn_radius]
        pinhole = (camera.lens_model or camera).undistort(measured)
        known = np.isfinite(pinhole).all(axis=1)
        pinhole, measured = pinhole[known], measured[known]
        flat = (pinhole - base.center) / base.mean_focal
        radius = np.linalg.norm(flat, axis=1)
        moved = np.einsum("ij,ij->i", (measured - base.distort(pinhole)) / base.focal, flat)
        return cls(pinhole, measured, radius, radius + moved / np.maximum(radius, 1e-300))

    def fit(self, ideal: FloatArray, powers: Sequence[int]) -> FloatArray:
        """Find coefficients (K,): ``u + Σ k u^p`` are the measured radii, ``u`` the ideal ones."""
        return _least_squares(ideal[:, None] ** np.array(powers), self.distorted - ideal)

    def fit_rational(self) -> FloatArray:
        """Find coefficients (6,): ``u (1 + k1 u² + k2 u⁴ + k3 u⁶) / (1 + k4 u² + k5 u⁴ + k6 u⁶)`` are the radii.

        Linear least squares, weighted by the denominator of the step before; of all steps the one with the smallest
        error is kept.
        """
        # Radii up to 1, whatever the unit: high powers of large ones are otherwise all that counts.
        size = float(self.undistorted.max())
        powers = (self.undistorted[:, None] / size) ** np.array([2, 4, 6])
        terms = np.hstack([self.undistorted[:, None] * powers, -self.distorted[:, None] * powers])
        denominator, best = np.ones_like(self.distorted), np.zeros(6)
        least = np.abs(self.undistorted - self.distorted).max()
        for _ in range(_RATIONAL_STEPS):
            k = _least_squares(terms / denominator[:, None], (self.distorted - self.undistorted) / denominator)
            denominator = 1.0 + powers @ k[3:]
            if not (denominator > 1e-3).all():
                break
            error = np.abs(self.undistorted * (1.0 + powers @ k[:3]) / denominator - self.distorted).max()
            best, least = (k, error) if error < least else (best, least)
        return np.asarray(best / np.tile(size ** np.array([2.0, 4.0, 6.0]), 2))

    def compare(self, lens: LensModel) -> LensFit:
        """Compare a model's measured points with these."""
        error = np.linalg.norm(lens.distort(self.pinhole) - self.measured, axis=1)
        return LensFit(float(np.sqrt(np.mean(error**2))), float(error.max()))


class OpenCVModel(NamedTuple):
    """A lens model of OpenCV."""

    kind: LensKind
    powers: tuple[int, ...]  # of the undistorted radius, or of a fisheye's angle, beside that itself; rational without
    fitted: tuple[int | None, ...]  # which of their coefficients each of OpenCV's is, None for the tangential ones


TWO_TERMS = OpenCVModel("brown", (3, 5), (0, 1, None, None))
POLYNOMIAL = OpenCVModel("brown", (3, 5, 7), (0, 1, None, None, 2))
RATIONAL = OpenCVModel("brown", (), (0, 1, None, None, 2, 3, 4, 5))
FISHEYE = OpenCVModel("fisheye", (3, 5, 7, 9), (0, 1, 2, 3))


def nearest_model(
    camera: Camera, names: Mapping[OpenCVModel, str], close: float = CLOSE
) -> tuple[LensModel, LensFit, str]:
    """The lens as one of the models that have a name, and that: the first so close, pixels, or else the nearest.

    A lens of another program's calibration is given as it is where a model has all its terms; else the radial terms are
    fitted, and its two focal lengths and its tangential terms kept.
    """
    lens, fits = camera.lens_model, []
    if lens is not None and math.isclose(lens.mean_focal, camera.focal or 0.0):
        for model, name in names.items():
            count = len(model.fitted)
            if model.kind == lens.kind and not any(lens.coefficients[count:]):
                padded = (*lens.coefficients, *[0.0] * count)[:count]
                return replace(lens, coefficients=padded), LensFit(0.0, 0.0), name
    for model, name in names.items():
        base = _without_radial_terms(camera, model.kind)
        samples = LensSamples.of(camera, base)
        ideal = np.arctan(samples.undistorted) if model is FISHEYE else samples.undistorted
        numbers = samples.fit(ideal, model.powers) if model.powers else samples.fit_rational()
        k = tuple(base.coefficients[i] if at is None else float(numbers[at]) for i, at in enumerate(model.fitted))
        fits.append((fitted := replace(base, coefficients=k, kind=model.kind), samples.compare(fitted), name))
        if fits[-1][1].largest <= close:
            break
    return min(fits, key=lambda one: one[1].largest)


def kind_of(fisheye: bool) -> LensKind:
    """The word for a model of OpenCV."""
    return "fisheye" if fisheye else "brown"


def _without_radial_terms(camera: Camera, kind: LensKind) -> LensModel:
    """The camera's focal length, and the two directions' difference and the tangential terms of its lens."""
    lens, focal = camera.lens_model, camera.with_guessed_focal().focal
    assert focal is not None
    if lens is None:
        return LensModel((focal, focal), camera.center, (0.0,) * 4)
    unit = focal / lens.mean_focal
    tangential = (*lens.coefficients, *[0.0] * 4)[2:4] if lens.kind == kind == "brown" else (0.0, 0.0)
    k = (0.0, 0.0, *(value * unit for value in tangential))
    return LensModel((lens.focal[0] * unit, lens.focal[1] * unit), lens.center, k)


@dataclass(frozen=True)
class CameraFile:
    """A camera as a file tells it."""

    camera: Camera
    kind: str  # whose format it is: "rdstitch", "OpenCV", "COLMAP", "Kalibr", "OpenDroneMap", "Hugin" or "lensfun"
    # how well the division model agrees with the file's own lens model, which stays with the camera where that is not
    # exactly; None where the file gives λ itself
    fit: LensFit | None = None


def fitted_camera(lens: LensModel, kind: str, size: tuple[int, int], field: str = "") -> CameraFile:
    """Fit the division model to the lens model of a file, which goes with it where it is not exactly that."""
    if not min(lens.focal) > 0.0:
        raise ArgumentError(f"expected positive focal lengths, not {lens.focal[0]:g} and {lens.focal[1]:g}")
    camera = Camera(size, center=lens.center, focal=lens.mean_focal, focal_source="file")
    try:
        fitted, fit = fit_lens(lens.distort, camera)
    except ArgumentError as error:
        raise ArgumentError(f"{field}{error}") from error
    return CameraFile(fitted if fit.largest <= _RESOLVED else replace(fitted, lens_model=lens), kind, fit)


def fit_lens(forward: Forward, camera: Camera) -> tuple[Camera, LensFit]:
    """Fit the division model to another lens model: with λ alone where that is enough, else with μ, else with ν too."""
    pinhole, measured, weights = _rays(forward, camera)
    flat, bent = camera.normalize(pinhole), camera.normalize(measured)
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
        error = np.linalg.norm(lens.distort(pinhole) - measured, axis=1)
        if not np.isfinite(error).all():
            continue
        fit = LensFit(float(np.sqrt(weights @ error**2 / weights.sum())), float(error.max()))
        if best is None or fit.largest < 0.5 * best[1].largest:
            best = lens, fit
        if best[1].largest <= CLOSE:
            break
    if best is None or best[1].largest > _MAX_ERROR * camera.scale:
        raise ArgumentError("the lens is far from every lens that the division model can describe")
    return best


def _fit_divisor(radius2: FloatArray, divisor: FloatArray, weights: FloatArray, count: int) -> list[float]:
    """``count`` coefficients of ``g`` for which undistorted radii give the measured ones, by weighted least squares."""
    terms = radius2[:, None] ** np.arange(1, count + 1)
    solution = np.zeros(count)
    for _ in range(_STEPS):
        # An error of g moves the measured radius by r / (g - 2 q g').
        slope = divisor - 2.0 * terms @ (np.arange(1, count + 1) * solution)
        weight = np.sqrt(weights * radius2) / np.maximum(slope, 1e-2)
        solution = _least_squares(weight[:, None] * terms, weight * (divisor - 1.0))
    return solution.tolist()


def _rays(forward: Forward, camera: Camera) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points along rays from the centre to the border of the measured image: pinhole, measured, and their areas."""
    angles = np.arange(_RAYS) * (2.0 * np.pi / _RAYS)
    radii = np.linspace(0.0, _REACH * camera.scale, _SAMPLES + 1)[1:]
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None] * radii[None, :, None] + camera.center
    with np.errstate(all="ignore"):
        measured = forward(rays.reshape(-1, 2)).reshape(rays.shape)
        distance = np.linalg.norm(measured - camera.center, axis=2)
        steps = np.diff(distance, axis=1, prepend=0.0)
    within = (measured > -0.5) & (measured < np.array(camera.image_size) - 0.5)
    inside = within[..., 0] & within[..., 1]
    # Along each ray, what comes before it leaves the image for the first time; with a fisheye of 180 degrees and
    # more it never does, and of what is near the horizon there is no need to know.
    leaves = np.where(inside.all(axis=1), _SAMPLES, np.argmin(inside, axis=1))
    seen = np.arange(_SAMPLES) < leaves[:, None]
    if not inside[:, 0].all() or not (steps[seen] > 0.0).all():
        raise ArgumentError("the lens model folds the image; it does not belong to images of this size")
    return rays[seen], measured[seen], (distance * steps)[seen]
