"""Where several pairs of images have static matches, and the matches of other pairs that lie elsewhere or move."""

from dataclasses import dataclass

import numpy as np

from rdstitch.features import Correspondences
from rdstitch.scipy_parts import spatial


@dataclass(frozen=True)
class StaticPlaces:
    """Where several pairs have static matches.

    A feature there that is matched otherwise at first is left by
    :func:`rdstitch.matching.static_background.moving_features`, and then finds what is static in other images.

    Attributes
    ----------
    places : "spatial.cKDTree"
        Of shape (P, 2), pixels.
    radius : float
        Around a place, and motion of a static match at most, pixels.
    """

    places: "spatial.cKDTree"
    radius: float

    def without_static(self, matched: Correspondences) -> Correspondences:
        """The matches that move, or begin elsewhere."""
        moved = np.linalg.norm(matched.points2 - matched.points1, axis=1)
        distance, _ = self.places.query(matched.points1, distance_upper_bound=self.radius)
        return matched.take(np.flatnonzero((moved > self.radius) | ~np.isfinite(distance)))
