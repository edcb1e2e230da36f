"""The division model of lens distortion: ``x_u = x_d / g(r²)`` with ``g(q) = 1 + λ q + μ q² + ν q³``, ``r = |x_d|``.

With λ alone this is the one-parameter model (Fitzgibbon 2001; Valtonen Örnhag et al., eq. 2); λ < 0 is barrel
distortion. A stereographic fisheye is exactly that; three coefficients describe equidistant and equisolid fisheyes of
150 degrees to 0.07 pixels where λ alone leaves 4 to 6.

Points are normalized: the distortion centre is the origin, the unit is half the image diagonal unless stated.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray

MAX_ABS_DISTORTION = 0.98
"""Largest ``|λ|`` that is estimated, half-diagonal frame; at 1 the model folds at the corner of the image."""

SEARCHED_DISTORTION = (-0.95, 0.5)
"""Limits of λ that the sampling of pairs searches: from nearly folding barrel to strong pincushion distortion."""

SOLVED_DISTORTION = (-1.5, 0.5)
"""Limits of λ in which a minimal solver looks for roots unless others are given; in the frame of its points, which for
focal-normalized points of a wide lens reaches further than half diagonals."""

OBSERVABLE_STD = 0.1
"""Standard deviation of λ from which on it counts as not observable: a tenth of the radius at the corner."""

_NEWTON_STEPS = 40
_NEWTON_TOLERANCE = 1e-14
_STEP_TOLERANCE = 1e-9  # last step of it: the error left is its square
_RATIO_STEPS = 12
_FARTHEST = 4.0
"""Half diagonals: with more coefficients than λ the model is not used beyond, where only the highest power counts."""

_STRETCH_SAMPLES = 4096

_NEAREST_STEPS = 20
_NEAREST_TOLERANCE = 1e-13


def divisor(radius2: FloatArray, distortion: ArrayLike, higher: Sequence[float] = ()) -> FloatArray:
    """``g`` at squared radii of measured points; λ broadcasts, ``higher`` are μ and ν."""
    tail = horner(higher, radius2)
    return 1.0 + (np.asarray(distortion) + tail) * radius2


def divisor_slope(radius2: FloatArray, distortion: ArrayLike, higher: Sequence[float] = ()) -> FloatArray:
    """Derivative of ``g`` by the squared radius: ``λ + 2 μ q + 3 ν q²``."""
    return np.asarray(distortion) + horner([(k + 2) * c for k, c in enumerate(higher)], radius2)


def undistort(points: ArrayLike, distortion: ArrayLike, higher: Sequence[float] = ()) -> FloatArray:
    """Undistort normalized points (..., 2); λ broadcasts, but is one number where there are μ and ν, ``higher``.

    NaN outside the domain: where ``g`` is not positive, and beyond the radius at which the undistorted one stops
    growing.
    """
    x = np.asarray(points, dtype=np.float64)
    radius2 = np.einsum("...i,...i->...", x, x)
    g = divisor(radius2, distortion, higher)
    if any(higher):
        inside = radius2 < valid_radius(float(np.asarray(distortion).item()), tuple(higher)) ** 2
    else:
        inside = (g > 0.0) & (np.asarray(distortion) * radius2 < 1.0)
    return x / np.where(inside, g, np.nan)[..., None]


def distort(points: ArrayLike, distortion: ArrayLike, higher: Sequence[float] = ()) -> FloatArray:
    """Distort normalized points: the inverse of :func:`undistort`; NaN where no point of the domain maps to one.

    For λ alone in closed form, ``x_d = 2 x_u / (1 + sqrt(1 - 4 λ |x_u|²))``, which is stable at λ = 0 and at the
    centre; otherwise by Newton's method on the radius, with bisection where a step leaves the domain.
    """
    x = np.asarray(points, dtype=np.float64)
    return x * measured_ratio(np.einsum("...i,...i->...", x, x), distortion, higher)[..., None]


def measured_ratio(radius2: FloatArray, distortion: ArrayLike, higher: Sequence[float] = ()) -> FloatArray:
    """Measured over undistorted radius, from the squared undistorted one, as :func:`distort` has it."""
    if not any(higher):
        return distorted_ratio(radius2, np.asarray(distortion))
    radius = np.sqrt(radius2)
    measured = _distorted_radius(radius, float(np.asarray(distortion).item()), tuple(higher))
    return np.where(radius > 0.0, measured / np.maximum(radius, 1e-300), 1.0)


def distorted_ratio(radius2: FloatArray, distortion: FloatArray, distortion2: FloatArray | None = None) -> FloatArray:
    """Measured over undistorted radius, from the squared undistorted radius; NaN where there is none.

    Unlike for :func:`distort`, μ broadcasts too: from the root for λ alone, by Newton's method on
    ``k = 1 + λ k² r² + μ k⁴ r⁴``.
    """
    discriminant = 1.0 - 4.0 * distortion * radius2
    if distortion2 is None:
        root: FloatArray = np.sqrt(np.where(discriminant >= 0.0, discriminant, np.nan))
        return 2.0 / (1.0 + root)
    with np.errstate(over="ignore", invalid="ignore"):
        ratio = 2.0 / (1.0 + np.sqrt(np.maximum(discriminant, 0.0)))
        for _ in range(_RATIO_STEPS):
            value, slope = _ratio_equation(ratio, radius2, distortion, distortion2)
            step = value / np.where(slope < 0.0, slope, -1.0)
            ratio = ratio - step
            if not (np.abs(step) > _NEWTON_TOLERANCE).any():
                break
        value, slope = _ratio_equation(ratio, radius2, distortion, distortion2)
    solved = (np.abs(value) <= 1e-9 * np.abs(ratio)) & (ratio > 0.0) & (slope < 0.0)
    return np.where(solved, ratio, np.nan)


def _ratio_equation(
    ratio: FloatArray, radius2: FloatArray, distortion: FloatArray, distortion2: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """``1 - k + λ k² r² + μ k⁴ r⁴`` and its derivative by k."""
    value = 1.0 - ratio + distortion * ratio**2 * radius2 + distortion2 * ratio**4 * radius2**2
    slope = -1.0 + 2.0 * distortion * ratio * radius2 + 4.0 * distortion2 * ratio**3 * radius2**2
    return value, slope


@lru_cache(maxsize=256)
def valid_radius(distortion: float, higher: tuple[float, ...] = ()) -> float:
    """Largest measured radius up to which the model is one-to-one, in the unit of the coefficients; may be inf.

    That is the first zero of ``g``, where points come from infinity, or of ``g - 2 q g'``, to which the derivative of
    the undistorted radius is proportional, whichever is nearer.
    """
    zeros = horizon_radius(distortion, higher), _fold_radius(distortion, higher)
    return min(*zeros, _FARTHEST) if any(higher) else min(zeros)


@lru_cache(maxsize=256)
def horizon_radius(distortion: float, higher: tuple[float, ...] = ()) -> float:
    """Measured radius of the rays at 90 degrees to the axis, the first zero of ``g``; inf if there is none."""
    return _first_zero(np.array([distortion, *higher]))


@lru_cache(maxsize=256)
def stretch_radius(distortion: float, higher: tuple[float, ...], stretch: float) -> float:
    """Measured radius up to which the lens stretches what it shows by less than a factor; less than the valid one.

    The stretch is the derivative of the undistorted radius, ``(g - 2 q g') / g²``.
    """
    limit = min(valid_radius(distortion, higher), _FARTHEST)
    radii = np.linspace(0.0, limit, _STRETCH_SAMPLES, endpoint=False)
    q = radii**2
    g = divisor(q, distortion, higher)
    beyond = g - 2.0 * q * divisor_slope(q, distortion, higher) > stretch * g**2
    return float(radii[np.argmax(beyond) - 1]) if beyond.any() else limit


@lru_cache(maxsize=256)
def _fold_radius(distortion: float, higher: tuple[float, ...]) -> float:
    """Measured radius at which the undistorted one stops growing, the first zero of ``g - 2 q g'``; inf for none."""
    coefficients = np.array([distortion, *higher])
    return _first_zero(-(2.0 * np.arange(1, len(coefficients) + 1) - 1.0) * coefficients)


def nearest_one_parameter(radius2: FloatArray, distortion: float, higher: Sequence[float] = ()) -> tuple[float, float]:
    """The λ of the one-parameter model nearest to a lens, by least squares of measured radii; these are given squared.

    Given too is the factor by which undistorted points of the lens are to be *divided* before they are distorted with
    it: the scale of the undistorted image is free, as no image of a plane shows it. So this is the λ that the
    estimation of one λ would find from points spread like those given.
    """
    # With t the scale, the undistorted radius becomes r / (t g): the nearest model measures that at
    # r + r (t g - 1 - λ q) / (t g - 2 λ q) to first order, which is linear in t and λ but for the denominator.
    g, radius = divisor(radius2, distortion, higher), np.sqrt(radius2)
    solution = np.array([1.0, distortion])
    for _ in range(_NEAREST_STEPS):
        weight = radius / np.maximum(solution[0] * g - 2.0 * solution[1] * radius2, 1e-3)
        previous = solution
        solution = np.linalg.lstsq(weight[:, None] * np.stack([g, -radius2], axis=1), weight, rcond=None)[0]
        if np.abs(solution - previous).max() < _NEAREST_TOLERANCE:
            break
    scale, nearest = solution.tolist()
    return nearest, scale


def horner(coefficients: Sequence[float], q: FloatArray) -> FloatArray | float:
    """``c1 q + c2 q² + …``."""
    total: FloatArray | float = 0.0
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * q
    return total


def _first_zero(coefficients: FloatArray) -> float:
    """The smallest radius at which ``1 + c1 q + c2 q² + …`` of its square is zero; inf if there is none."""
    if not np.isfinite(coefficients).all():  # beyond what can be computed with: at the centre
        return 0.0
    inverse = np.roots([1.0, *coefficients])  # roots in 1 / q, which exist whatever coefficients are zero
    largest = inverse.real[np.abs(inverse.imag) <= 1e-9 * np.abs(inverse)].max(initial=0.0)
    with np.errstate(divide="ignore", over="ignore"):  # the zero of a subnormal λ is so far out that its square is inf
        return float(np.sqrt(1.0 / largest))


def _distorted_radius(radius: FloatArray, distortion: float, higher: tuple[float, ...]) -> FloatArray:
    """Solve ``r = r_u g(r²)`` for the measured radius within the domain; NaN where there is none.

    By Newton's method from the root for λ alone. The domain has one root at most: a step that leaves what is left of it
    is replaced by its middle.
    """
    limit = valid_radius(distortion, higher)
    with np.errstate(all="ignore"):
        solvable = limit - radius * float(divisor(np.asarray(limit**2), distortion, higher)) > 0.0
        discriminant = np.maximum(1.0 - 4.0 * distortion * radius**2, 0.0)
        measured = np.minimum(2.0 * radius / (1.0 + np.sqrt(discriminant)), limit)
        low, high = np.zeros_like(radius), np.full_like(radius, limit)
        for _ in range(_NEWTON_STEPS):
            q = measured**2
            value = measured - radius * divisor(q, distortion, higher)
            low, high = np.where(value > 0.0, low, measured), np.where(value > 0.0, measured, high)
            following = measured - value / (1.0 - 2.0 * radius * measured * divisor_slope(q, distortion, higher))
            following = np.where((following >= low) & (following <= high), following, (low + high) / 2.0)
            step, measured = np.abs(following - measured), following
            if not (solvable & (step > _STEP_TOLERANCE * limit)).any():
                break
    return np.where(solvable, measured, np.nan)


def is_one_to_one(radius: float, distortion: float, higher: Sequence[float] = ()) -> bool:
    """Check whether the model holds out to a radius."""
    return valid_radius(float(distortion), tuple(map(float, higher))) > radius


def folds(radius: float, distortion: float, higher: Sequence[float] = ()) -> bool:
    """Check whether the undistorted radius stops growing within a radius, among rays that are before the camera."""
    return _fold_radius(distortion, tuple(higher)) <= min(radius, horizon_radius(distortion, tuple(higher)))
