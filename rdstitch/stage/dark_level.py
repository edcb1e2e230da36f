"""The dark level D of tiles, which light does not multiply, by photon transfer.

It is where the variance of photon noise, which is in proportion to the light, becomes 0. Few samples, and those
that are no counts of light, as of JPEG files, show none.
"""

import math
from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray

_PARTS = 4  # of the tiles, by which the error of the dark level is known
_KNOWN = 3.0  # standard deviations from 0 from which on it is taken out
_BINS = 24  # of brightness, by which noise is compared with light
_LEAST_BINS = 6
_LEAST_IN_BIN = 16  # cells


@dataclass(frozen=True)
class DarkLevel:
    """The dark level of a channel, in units of the samples."""

    level: float
    std: float


def dark_level(light: FloatArray, variance: FloatArray) -> DarkLevel | None:
    """Estimate D by light and noise of cells, with its error by parts of the tiles; None where they do not show it."""
    level = _by_photon_noise(light, variance)
    parts = [_by_photon_noise(light[k::_PARTS], variance[k::_PARTS]) for k in range(_PARTS)]
    known = [part for part in parts if part is not None]
    if level is None or len(known) < _PARTS:
        return None
    std = float(np.std(known, ddof=1)) / math.sqrt(_PARTS)
    return DarkLevel(level, std) if level >= _KNOWN * std else None


def _by_photon_noise(light: FloatArray, variance: FloatArray) -> float | None:
    """D where the variance of noise is in proportion to the light; None where it is not."""
    mean, noise = light.ravel(), variance.ravel()
    count = min(_BINS, len(mean) // _LEAST_IN_BIN)
    if count < _LEAST_BINS:
        return None
    bins = np.array_split(np.argsort(mean), count)
    x = np.array([np.median(mean[part]) for part in bins])
    # Of each bin the lower part: texture, too, is taken for noise.
    y = np.array([np.quantile(noise[part], 0.25) for part in bins])
    first, second = np.triu_indices(len(x), 1)
    distinct = x[second] - x[first] > 0.0
    slopes = (y[second] - y[first])[distinct] / (x[second] - x[first])[distinct]
    low, slope = np.quantile(slopes, [0.16, 0.5]) if len(slopes) else (0.0, 0.0)
    if not low > 0.0:
        return None
    dark = float(np.median(x - y / slope))
    return dark if 0.0 < dark < float(np.quantile(mean, 0.01)) else None
