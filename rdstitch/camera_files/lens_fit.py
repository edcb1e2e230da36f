"""From one lens model to another, by least squares over the picture, with what that costs in px.

Every model is a *forward* map: px of a lens without distortion to measured px. The division model is fitted to others
so that the measured px agree; polynomials are fitted to the division model in the same way.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.division_model import MAX_ABS_DISTORTION, distort
from rdstitch.errors import ArgumentError

Forward = Callable[[FloatArray], FloatArray]

_GRID = 65  # points along each side of the picture that polynomials are fitted at
_RAYS, _STEPS, _REACH = 64, 1200, 8.0  # where other models are looked at: directions, steps, half diagonals


@dataclass(frozen=True)
class LensFit:
    """How well a fitted lens model agrees with the one it was fitted to.

    Attributes
    ----------
    rms, largest : float
        Of the distances between the px that both models give, over the whole picture, px.
    """

    rms: float
    largest: float


def fit_polynomial(camera: Camera, unit: float, powers: Sequence[int]) -> tuple[FloatArray, LensFit]:
    """Fit ``r_d = r_u + Σ k_j r_u^p_j`` to the division model of a camera.

    Parameters
    ----------
    camera : Camera
    unit : float
        What radii are measured in, px.
    powers : sequence of int
        Exponents, each above 1, so that the scale at the centre stays.

    Returns
    -------
    ndarray of shape (len(powers),), LensFit
        The coefficients.
    """
    width, height = camera.image_size
    u, v = np.meshgrid(np.linspace(-0.5, width - 0.5, _GRID), np.linspace(-0.5, height - 0.5, _GRID))
    measured = np.column_stack([u.ravel(), v.ravel()])
    straight = np.linalg.norm(camera.undistort(measured) - camera.center, axis=1) / unit
    bent = np.linalg.norm(measured - camera.center, axis=1) / unit
    terms = straight[:, None] ** np.asarray(powers)
    # Columns of one size, whatever the unit: high powers of large radii are otherwise all that counts.
    size = np.abs(terms).max(axis=0)
    coefficients = np.linalg.lstsq(terms / size, bent - straight, rcond=None)[0] / size
    error = np.abs(straight + terms @ coefficients - bent) * unit
    return coefficients, LensFit(float(np.sqrt(np.mean(error**2))), float(error.max()))


def fit_division(forward: Forward, camera: Camera) -> tuple[float, LensFit]:
    """Fit λ to another lens model.

    Parameters
    ----------
    forward : callable
        The other model: px without distortion (N, 2) to measured px (N, 2).
    camera : Camera
        Size and distortion centre of the picture.

    Returns
    -------
    float, LensFit
        λ in the half-diagonal frame.

    Raises
    ------
    ArgumentError
        When the other model folds the picture, or is far from every λ.
    """
    straight, measured, weights = _rays(forward, camera)
    flat, bent = camera.normalize(straight), camera.normalize(measured)
    farthest = float(np.einsum("ij,ij->i", flat, flat).max())
    corner = float(np.square(camera.normalize(camera.outline(1))).sum(axis=1).max())
    low, high = -MAX_ABS_DISTORTION / corner, 0.25 * MAX_ABS_DISTORTION / farthest
    # Imported late: whoever converts no lens should not wait for SciPy's optimizers.
    from scipy.optimize import minimize_scalar

    def cost(distortion: float) -> float:
        return float(weights @ np.square(distort(flat, distortion) - bent).sum(axis=1))

    found = minimize_scalar(cost, bounds=(low, high), method="bounded", options={"xatol": 1e-12})
    distortion = float(found.x)
    if not math.isfinite(found.fun) or min(distortion - low, high - distortion) < 1e-3 * (high - low):
        raise ArgumentError("the lens is far from every lens that one λ can describe")
    error = np.linalg.norm(distort(flat, distortion) - bent, axis=1) * camera.half_diagonal
    return distortion, LensFit(float(np.sqrt(weights @ error**2 / weights.sum())), float(error.max()))


def _rays(forward: Forward, camera: Camera) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points along rays from the centre to the border of the measured picture: straight, measured, and their areas."""
    angles = np.arange(_RAYS) * (2.0 * np.pi / _RAYS)
    radii = np.linspace(0.0, _REACH * camera.half_diagonal, _STEPS + 1)[1:]
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None] * radii[None, :, None] + camera.center
    with np.errstate(all="ignore"):
        measured = forward(rays.reshape(-1, 2)).reshape(rays.shape)
        distance = np.linalg.norm(measured - camera.center, axis=2)
        steps = np.diff(distance, axis=1, prepend=0.0)
    within = (measured > -0.5) & (measured < np.array(camera.image_size) - 0.5)
    inside = within[..., 0] & within[..., 1]
    # Along each ray, what comes before it leaves the picture for the first time.
    leaves = np.argmin(inside, axis=1)
    seen = np.arange(_STEPS) < leaves[:, None]
    if inside.all(axis=1).any() or not inside[:, 0].all() or not (steps[seen] > 0.0).all():
        raise ArgumentError("the lens model folds the picture; it does not belong to pictures of this size")
    return rays[seen], measured[seen], (distance * steps)[seen]
