"""Where each picture was taken, as far as its GPS position says."""

from collections.abc import Sequence

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.inputs.source import Source


def positions_of(sources: Sequence[Source]) -> FloatArray:
    """Points on the unit sphere (N, 3), whose distances are those of the pictures' positions; NaN where unknown."""
    known = [source.metadata.gps for source in sources]
    degrees = [(np.nan, np.nan) if gps is None else (gps.latitude, gps.longitude) for gps in known]
    latitude, longitude = np.radians(np.array(degrees, dtype=np.float64).reshape(-1, 2)).T
    return np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=1
    )
