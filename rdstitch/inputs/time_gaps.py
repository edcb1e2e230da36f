"""Gaps in a table of measurements by time, in which its device had stopped: there is nothing to interpolate between."""

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray

# Intervals that only a twentieth of a table exceeds: a logger that drops rows, or thins them, stays below.
_GAP = 10.0


def in_gap(times: FloatArray, at: FloatArray) -> BoolArray:
    """Check which times (N,) lie between two rows of a table (M,), ascending, that are much further apart than others.

    A table of fewer than some twenty rows has no usual interval, and no gap.
    """
    intervals = np.diff(times)
    if len(intervals) == 0:
        return np.zeros(np.shape(at), dtype=bool)
    usual = np.percentile(intervals, 95.0, method="higher")
    after = np.clip(np.searchsorted(times, at), 1, len(intervals))
    within = (times[after - 1] < at) & (at < times[after])
    return within & (intervals[after - 1] > _GAP * usual)
