"""Homography and, for each of the two images, a λ of its own: what a pair sees of two lenses.

A lens that is no division model, or whose axis misses the centre of the image, bends one part of an image more than
another, and the two images of a pair overlap in different parts of them. So that this is not taken for two lenses, μ
and the distortion centre, which both images share, are free too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.numerics.nearest_points import SAME_FEATURE, separate_neighbours
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.pair_models import HomographyPairModel
from rdstitch.robust.priors import LENS_PRIORS, Prior
from rdstitch.robust.refinement import PairProblems, descend

_HOMOGRAPHY = HomographyPairModel()
_LENS = (Prior(), Prior(), LENS_PRIORS[1], *LENS_PRIORS[3:])
"""Priors on λ of image 1, λ of image 2, μ, and the distortion centre. The votes of all pairs measure λ: a prior in each
of them would count as often."""

_ITERATIONS = 20


@dataclass(frozen=True, eq=False)
class PerImageDistortion:
    """λ of both images of a pair, half-diagonal frame."""

    distortion: FloatArray  # (2,)
    covariance: FloatArray  # (2, 2)
    # correlation of the errors of neighbours that are left: 0 for noise, up to 1 where depth moves them together
    coherence: float


def estimate_per_image_distortion(
    relations: Sequence[RadialHomography], data: Measurements, threshold: float
) -> list[PerImageDistortion]:
    """Free λ of each image of pairs, from the relations that one λ gave.

    ``relations``: one a pair; ``data``: also of what one λ could not explain; ``threshold``: largest transfer error of
    an inlier, pixels.
    """
    count, lens = len(data), len(_LENS)
    parameters = np.zeros((count, lens + 9))
    parameters[:, :2] = [[relation.distortion] * 2 for relation in relations]
    parameters[:, lens:] = _HOMOGRAPHY.initialize(np.stack([relation.homography for relation in relations]))
    with np.errstate(all="ignore"):  # a step may leave the domain of the lens model
        problems = PairProblems(_HOMOGRAPHY, data, np.full(count, threshold), lens=_LENS)
        parameters, equations = descend(problems, parameters, _ITERATIONS)
        covariance = problems.covariances(parameters, equations)
        inliers = equations.squared < equations.scale[:, None] ** 2
    coherence = [
        _coherence(points[:, row].T, errors[:, row].T)
        for points, errors, row in zip(data.x1, equations.transferred.columns[:, -1], inliers, strict=True)
    ]
    return [
        PerImageDistortion(row[:2], known[:2, :2], shared)
        for row, known, shared in zip(parameters, covariance, coherence, strict=True)
    ]


def _coherence(points: FloatArray, errors: FloatArray) -> float:
    """Correlation of the errors (N, 2) of points (N, 2), half diagonals, and their nearest neighbours."""
    if len(points) < 2:
        return 0.0
    distance, nearest = separate_neighbours(points)
    separate = distance > SAME_FEATURE
    errors, other = errors[separate], errors[nearest[separate]]
    power = float(np.einsum("ni,ni->", errors, errors))
    return float(np.einsum("ni,ni->", errors, other)) / power if power > 0.0 else 0.0
