"""How far the lens is determined, in words: what the user reads of it after a calibration."""

import math

import numpy as np

from rdstitch.alignment.lens.lens_selection import CENTER
from rdstitch.alignment.result import Alignment
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import LENS_PARAMETERS, Camera
from rdstitch.geometry.division_model import divisor, divisor_slope


def describe_camera(alignment: Alignment, camera: Camera) -> tuple[str, ...]:
    """The lines of :func:`describe_lens`, one on the focal length, and one on the tilt."""
    if camera.focal is None or camera.focal_std is None or alignment.focal is None:
        unseen = "focal length and tilt are not observable with one homography per image"
        return (*describe_lens(alignment, camera), unseen)
    lines = [f"focal length {camera.focal:.1f} ± {camera.focal_std:.1f} pixels"]
    if camera.tilt is not None and camera.tilt_std is not None:
        (psi, theta), (psi_std, theta_std) = np.degrees(camera.tilt), np.degrees(camera.tilt_std)
        spread = math.degrees(alignment.tilt_spread)
        varies = f", of single images ± {spread:.2f}" if spread else ""
        lines.append(f"tilt ψ = {psi:.3f} ± {psi_std:.3f}, θ = {theta:.3f} ± {theta_std:.3f} degrees{varies}")
    return (*describe_lens(alignment, camera), *lines)


def describe_lens(alignment: Alignment, camera: Camera) -> tuple[str, ...]:
    """One line on λ, one on each of μ, ν and the distortion centre, and one on the choice of the lens.

    ``camera`` is that of the reference image, upright or as it is stored.
    """
    if not alignment.lens_observable:
        return ("λ is not observable",)
    if alignment.lens_given and camera.lens_covariance is None:
        return (f"λ = {alignment.distortion:.6f}, given",)
    free, std = np.array([name in alignment.parameters for name in LENS_PARAMETERS]), np.zeros(len(LENS_PARAMETERS))
    if camera.lens_covariance is not None:
        std = np.sqrt(np.maximum(np.diag(np.array(camera.lens_covariance)), 0.0))
    first = f"λ = {alignment.distortion:.6f} ± {alignment.distortion_std:.6f}"
    if camera.higher:
        largest = camera.one_parameter_fit()[2]
        first += f" (the nearest one-parameter lens, at most {largest:.1f} pixels from the lens found)"
    lines, with_first = [first], f"with λ = {camera.distortion:.4f}"
    for ordinal, name, value, error, estimated in zip(
        ("second", "third"), "μν", camera.coefficients[1:], std[1:3], free[1:3], strict=True
    ):
        found = f"{name} = {value:.4f} ± {error:.4f}, {with_first}" if estimated else "not estimated"
        lines.append(f"{ordinal} coefficient {found}")
    middle = (np.array(camera.image_size) - 1.0) / 2.0
    if free[CENTER].all():
        x, y = camera.center
        dx, dy = std[CENTER] * camera.scale
        off = float(np.linalg.norm(camera.center - middle))
        lines.append(f"centre {x:.1f} ± {dx:.1f}, {y:.1f} ± {dy:.1f} pixels, {off:.1f} off the middle of the image")
    else:
        lines.append("distortion centre: the middle of the image")
    return (*lines, alignment.lens_reason)


def radius_std(camera: Camera, radii: FloatArray) -> FloatArray:
    """Standard deviation of where the lens measures the rays that it measures at some radii, pixels.

    Up to the scale of the undistorted image, which no image of a plane shows. The radii (N,) are half diagonals, evenly
    spaced from the distortion centre to the corner.
    """
    if camera.lens_covariance is None:
        return np.zeros_like(radii)
    q = radii**2
    g = divisor(q, camera.distortion, camera.higher)
    growth = g - 2.0 * q * divisor_slope(q, camera.distortion, camera.higher)
    by_coefficient = (radii / growth)[:, None] * q[:, None] ** np.arange(1, 4)
    by_scale = radii * g / growth
    # What a change of scale makes up for, by least squares over the area of the image, is no uncertainty.
    area = radii * by_scale
    by_coefficient = by_coefficient - np.outer(by_scale, area @ by_coefficient / max(float(area @ by_scale), 1e-300))
    covariance = np.array(camera.lens_covariance)[:3, :3]
    variance = np.einsum("ni,ij,nj->n", by_coefficient, covariance, by_coefficient)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)) * camera.scale)
