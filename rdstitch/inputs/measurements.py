"""Where images were taken by their GPS, in metres."""

from collections.abc import Sequence

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.geometry.crs import Crs
from rdstitch.geometry.places import GpsPosition
from rdstitch.inputs.source import Source


def positions_of(sources: Sequence[Source]) -> FloatArray:
    """Metres east and north (N, 2) of the median of the images' GPS positions; NaN where unknown."""
    return metres_around_median([source.metadata.gps for source in sources])


def metres_around_median(known: Sequence[GpsPosition | None]) -> FloatArray:
    """Metres east and north (N, 2) of the median of positions, on a conformal map; NaN where unknown."""
    degrees = [(np.nan, np.nan) if gps is None else (gps.latitude, gps.longitude) for gps in known]
    latitude, longitude = np.array(degrees, dtype=np.float64).reshape(-1, 2).T
    if not (places := np.isfinite(latitude)).any():
        return np.full((len(known), 2), np.nan)
    metres = np.full((len(known), 2), np.nan)
    metres[places] = Crs.nearest(latitude[places], longitude[places]).project(latitude[places], longitude[places])
    metres[~np.isfinite(metres).all(axis=1)] = np.nan
    around: FloatArray = metres - np.nanmedian(metres, axis=0)
    return around
