"""Where images were taken by their GPS, in metres."""

from collections.abc import Sequence

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.inputs.source import Source
from rdstitch.io.metadata import GpsPosition

_EARTH = 6_371_000.0  # m


def positions_of(sources: Sequence[Source]) -> FloatArray:
    """Metres east and north (N, 2) of the median of the images' GPS positions; NaN where unknown."""
    return metres_around_median([source.metadata.gps for source in sources])


def metres_around_median(known: Sequence[GpsPosition | None]) -> FloatArray:
    """Metres east and north (N, 2) of the median of positions; NaN where unknown."""
    degrees = [(np.nan, np.nan) if gps is None else (gps.latitude, gps.longitude) for gps in known]
    latitude, longitude = np.radians(np.array(degrees, dtype=np.float64).reshape(-1, 2)).T
    if np.isnan(latitude).all():
        return np.full((len(known), 2), np.nan)
    up = np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    x, y, z = np.nanmedian(up, axis=1)
    level = max(float(np.hypot(x, y)), 1e-12)
    east = np.array([-y, x, 0.0]) / level
    north = np.array([-x * z / level, -y * z / level, level])
    metres: FloatArray = _EARTH * (np.stack([east, north / np.linalg.norm(north)]) @ up).T
    return metres
