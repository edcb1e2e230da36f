"""The division model that is nearest to a lens model of others: λ alone where that is enough, else with μ, and ν."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.camera_files.lens_models import LensFit, LensModel, least_squares
from rdstitch.errors import ArgumentError

Forward = Callable[[FloatArray], FloatArray]

_STEPS = 8
_EXACT_ERROR = 0.1  # pixels: as exactly as a lens can be described at all
_MAX_ERROR = 0.1  # half diagonals: then the file is no lens of these images
_RAYS, _SAMPLES, _REACH = 64, 1200, 8.0  # where other models are looked at: directions, steps, half diagonals
_SQUARE = 0.005  # calibrations give focal lengths along x and y that differ by less


@dataclass(frozen=True)
class CameraFile:
    """A camera as a file tells it."""

    camera: Camera
    kind: str  # whose format it is: "rdstitch", "OpenCV", "COLMAP", "Kalibr", "OpenDroneMap", "Hugin" or "lensfun"
    fit: LensFit | None = None  # how well λ agrees with the file's own lens model; None where the file gives λ itself
    cause: str = ""  # what of the file's model λ cannot describe; empty where it is only the curve of the lens


def fitted_camera(
    forward: Forward,
    kind: str,
    size: tuple[int, int],
    center: tuple[float, float],
    focal: float,
    field: str = "",
    cause: str = "",
) -> CameraFile:
    """Fit λ to the lens model of a file."""
    camera = Camera(size, center=center, focal=focal, focal_source="file")
    try:
        lens, fit = fit_lens(forward, camera)
    except ArgumentError as error:
        raise ArgumentError(f"{field}{error}{cause and f'; {cause}'}") from error
    return CameraFile(lens, kind, fit, cause)


def fitted_lens(lens: LensModel, kind: str, size: tuple[int, int], field: str = "") -> CameraFile:
    """Fit λ to a lens model that several formats share, and say what of it λ cannot describe."""
    if not min(lens.focal) > 0.0:
        raise ArgumentError(f"expected positive focal lengths, not {lens.focal[0]:g} and {lens.focal[1]:g}")
    stretch = lens.focal[0] / lens.focal[1] - 1.0
    cause = ""
    if abs(stretch) > _SQUARE:
        cause = f"its focal lengths along x and y differ by {abs(stretch):.1%}, but only square pixels are known here"
    return fitted_camera(lens.distort, kind, size, lens.center, lens.mean_focal, field, cause)


def fit_lens(forward: Forward, camera: Camera) -> tuple[Camera, LensFit]:
    """Fit the division model to another lens model: with λ alone where that is enough, else with μ, else with ν too."""
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
    if best is None or best[1].largest > _MAX_ERROR * camera.scale:
        raise ArgumentError("the lens is far from every lens that the division model can describe")
    return best


def _fit_divisor(radius2: FloatArray, divisor: FloatArray, weights: FloatArray, count: int) -> list[float]:
    """``count`` coefficients of ``g`` for which undistorted radii give the measured ones, by weighted least squares."""
    terms = radius2[:, None] ** np.arange(1, count + 1)
    found = np.zeros(count)
    for _ in range(_STEPS):
        # An error of g moves the measured radius by r / (g - 2 q g').
        slope = divisor - 2.0 * terms @ (np.arange(1, count + 1) * found)
        weight = np.sqrt(weights * radius2) / np.maximum(slope, 1e-2)
        found = least_squares(weight[:, None] * terms, weight * (divisor - 1.0))
    return found.tolist()


def _rays(forward: Forward, camera: Camera) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points along rays from the centre to the border of the measured image: straight, measured, and their areas."""
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
