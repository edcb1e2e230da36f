"""A similarity of the plane between two sets of points of which some, fewer than half, are wrong."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray, evenly_spaced
from rdstitch.numerics.robust_loss import robust_weight

OUTLYING = 3.0
"""Standard deviations from which on a point is an outlier."""

_ANCHORS = 40  # points whose pairs are tried
_ROUNDS = 10

Points = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class SimilarityFit:
    """``target = scale * source + origin``, in complex numbers."""

    scale: complex
    origin: complex
    residuals: FloatArray  # (N,): distances from the targets, in their unit
    weights: FloatArray  # (N,): 1 of what agrees exactly, towards 0 of outliers
    inliers: NDArray[np.bool_]  # (N,), bool


def fit_similarity(source: Points, target: Points, std: float) -> SimilarityFit:
    """Fit by the least quantile of squares over pairs of points, then by weights that vanish for outliers.

    Least quantile of squares: Rousseeuw and Leroy, Robust Regression and Outlier Detection (1987), section 3.4.

    ``source, target`` (N,): two or more points; ``std``: standard deviation, positive, that targets have at least; the
    median residual counts where that is more.
    """
    count = len(source)
    anchors = evenly_spaced(count, _ANCHORS)
    one, two = (anchors[side] for side in np.triu_indices(len(anchors), 1))
    offset = source[two] - source[one]
    scale = np.divide(target[two] - target[one], offset, out=np.zeros_like(offset), where=offset != 0)
    residuals = np.abs(target - scale[:, None] * (source - source[one][:, None]) - target[one][:, None])
    # Two points always agree: the quantile is one of all that are not needed to fit.
    quantile = np.sort(residuals, axis=1)[:, (count + 3) // 2 - 1]
    width = OUTLYING * max(std, float(quantile.min()))
    best = int(np.argmin(np.minimum(residuals, width).sum(axis=1)))
    away = residuals[best]
    for _ in range(_ROUNDS):
        weights = robust_weight(away**2, width)
        a, b = np.average(source, weights=weights), np.average(target, weights=weights)
        power = float(np.vdot(source - a, weights * (source - a)).real)
        fitted = complex(np.vdot(source - a, weights * (target - b)) / max(power, 1e-300))
        origin = complex(b - fitted * a)
        away = np.abs(target - fitted * source - origin)
        width = OUTLYING * max(std, float(np.median(away)))
    return SimilarityFit(fitted, origin, away, weights, away <= width)
