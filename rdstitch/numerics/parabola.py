"""Peaks between samples."""

from typing import Any

import numpy as np

from rdstitch.arrays import FloatArray


def parabola_peak(before: Any, here: Any, after: Any) -> tuple[FloatArray, FloatArray]:
    """Where parabolas through three neighbouring values (...) of a peak are highest, and how high they are there.

    The place is given from the middle value on, in steps, at most half of one; of three equal values it is the middle.
    """
    before, here, after = (np.asarray(values, dtype=np.float64) for values in (before, here, after))
    rise, curvature = after - before, np.minimum(before + after - 2.0 * here, -np.finfo(np.float64).tiny)
    with np.errstate(over="ignore"):
        place = np.clip(-rise / (2.0 * curvature), -0.5, 0.5)
    return place, here + rise * place / 4.0
