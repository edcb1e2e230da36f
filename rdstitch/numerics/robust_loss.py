"""The robust loss of pairs and of the bundle adjustment, and the noise that its width follows.

Geman and McClure's ``e² / (1 + e²/w²)`` of an error's length e: the square for small errors, the width's square at
most, so that wrong matches lose their influence without ever being decided upon (Black and Rangarajan, IJCV 1996).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray

RAYLEIGH_MEDIAN = 1.1774
"""Median length of a two-dimensional normal vector of standard deviation 1: ``sqrt(2 log 2)``."""

NORMAL_MEDIAN = 0.6745
"""Median of the magnitude of a normal number of standard deviation 1."""

PAIR_WIDTH, ALIGNMENT_WIDTH = 4.0, 3.5
"""Widths of the loss in standard deviations of an error's coordinate.

A pair's noise is estimated from its few matches alone, so that its loss is a little wider. It does not matter much:
over 72 rendered pairs the median error of λ is 0.0017 at half that width, and 0.0015 at it and at twice it.
"""

# Halved or doubled, it changes the median error of λ by a sixth at most.
_MIN_NOISE = 0.02  # pixels; below, noise-free data would reject every model over rounding

_MIN_SIGMA = 1e-3
"""Pixels; a smaller one is not measurable, and errors are divided by it."""


def normal_std(values: NDArray[Any]) -> float:
    """Standard deviation of normal numbers about 0, among which there may be others, by their median magnitude."""
    return float(np.median(np.abs(values))) / NORMAL_MEDIAN


def sigma_of(squared: FloatArray) -> float:
    """Standard deviation of an error's coordinate, pixels, from the median of the squared lengths (M,); inf of none."""
    return max(float(np.sqrt(np.median(squared))) / RAYLEIGH_MEDIAN, _MIN_SIGMA) if len(squared) else np.inf


def noise_of(errors: FloatArray, threshold: FloatArray | float, fitted: int = 0) -> FloatArray:
    """Standard deviations per axis, pixels, (B,), from the median of the errors (B, N) below the threshold.

    ``fitted``: number of parameters that were fitted to them, which errors become smaller by.
    """
    count = (threshold > errors.T).sum(axis=0)
    ordered, rows = np.sort(errors, axis=1), np.arange(len(errors))
    lower, upper = (ordered[rows, np.maximum(count - 1, 0) // 2], ordered[rows, np.minimum(count // 2, count - 1)])
    shrunk = np.sqrt(np.maximum(1.0 - fitted / np.maximum(2 * count, 1), 0.5))
    return np.where(count > 0, np.maximum((lower + upper) / (2.0 * RAYLEIGH_MEDIAN * shrunk), _MIN_NOISE), _MIN_NOISE)


def loss_width(noise: FloatArray, threshold: FloatArray | float) -> FloatArray:
    """Scales of the loss, pixels, for errors of these standard deviations per axis."""
    return np.minimum(threshold, PAIR_WIDTH * noise)


def loss_ratio(squared: FloatArray, width: FloatArray | float) -> FloatArray:
    """The loss over the square of the error: 1 for small errors, 1/2 at ``width``, 0 for infinite ones."""
    ratio: FloatArray = 1.0 / (1.0 + squared / width**2)
    return ratio


def robust_weight(squared: FloatArray, width: FloatArray | float) -> FloatArray:
    """What an error counts in the normal equations: the derivative of the loss by the error's square."""
    return loss_ratio(squared, width) ** 2


def robust_slope(squared: FloatArray, width: float) -> FloatArray:
    """How much a weighted error grows with the error: its derivative, in the mean over all directions of the plane."""
    ratio = loss_ratio(squared, width)
    return ratio**2 * (2.0 * ratio - 1.0)


def robust_cost(squared: FloatArray, width: FloatArray | float) -> FloatArray:
    """The loss of errors, given their squares."""
    return width**2 * (1.0 - loss_ratio(squared, width))
