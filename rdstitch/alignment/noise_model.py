"""What models of the motion and of the lens are compared by: the noise of their errors, and how much of it is evidence.

Errors of neighbours agree, so that there are fewer independent observations than correspondences; and no lens or plane
is exact to better than about a tenth of a pixel, which therefore counts as noise.
"""

import math

import numpy as np

from rdstitch.alignment.bundle_adjustment import sigma_of
from rdstitch.alignment.cycle_consistency import misfitting_links
from rdstitch.alignment.link_equations import squared_lengths, whitened_errors
from rdstitch.alignment.observations import Observations
from rdstitch.alignment.planarity import coherence
from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.frozen import dataclass
from rdstitch.robust.loss import ALIGNMENT_WIDTH

EXACTNESS = 0.1
"""Pixels: how exactly a lens and a plane can be described at all."""

_MAX_ERROR2 = 1e12  # px²: what cannot be transferred counts as this


@dataclass(frozen=True)
class NoiseModel:
    """The noise of a set of errors.

    Attributes
    ----------
    noise : float
        Standard deviation of an error's coordinate when the model is right, pixels.
    overdispersion : float
        See :class:`rdstitch.alignment.planarity.Coherence`.
    counted : ndarray of shape (M,), bool
        Correspondences of links that fit.
    effective : float
        Independent observations.
    common : float
        Root mean square of what the errors of neighbours have in common, in diagonals of an image.
    """

    noise: float
    overdispersion: float
    counted: BoolArray
    effective: float
    common: float

    @classmethod
    def of_independent_links(cls, observations: Observations, errors: FloatArray) -> "NoiseModel":
        """From the whitened errors (M, 2) of links that were each fitted on their own, with a homography."""
        return cls.of_errors(observations, errors, max(1.0 - 4.0 * len(observations) / max(len(errors), 1), 0.1))

    @classmethod
    def of_errors(cls, observations: Observations, errors: FloatArray, freedom: float = 1.0) -> "NoiseModel":
        """From whitened errors (M, 2); ``freedom`` is the share of them that the parameters have not absorbed."""
        squared = squared_lengths(errors)
        sigma = sigma_of(squared[observations.scale_inliers_mask])
        inliers = squared <= (ALIGNMENT_WIDTH * sigma) ** 2
        agreement = coherence(observations, errors, inliers)
        counted = ~misfitting_links(squared, observations)[observations.link]
        effective = max(2.0 * float((counted & inliers).sum()) / agreement.overdispersion, 2.0)
        noise = math.hypot(sigma / math.sqrt(freedom), EXACTNESS)
        return cls(noise, agreement.overdispersion, counted, effective, agreement.relative_size)

    @property
    def price(self) -> float:
        """What a parameter must gain (Schwarz's criterion)."""
        return math.log(self.effective)

    def misfit(self, squared: FloatArray) -> FloatArray:
        """Robust squares of the errors that count, in units of the noise, from the squares of all (M,)."""
        ratio = np.minimum(squared[self.counted], _MAX_ERROR2) / self.noise**2
        misfit: FloatArray = ALIGNMENT_WIDTH**2 * np.log1p(ratio / ALIGNMENT_WIDTH**2) / self.overdispersion
        return misfit


def noise_of_links(observations: Observations, homographies: FloatArray, lens: FloatArray) -> NoiseModel:
    """The noise that every link leaves on its own, with its homography (L, 3, 3)."""
    return NoiseModel.of_independent_links(observations, whitened_errors(observations, homographies, lens))
