"""Every link on its own, with the lens and the camera in common: robust, because no wrong link can pull at another."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rdstitch.alignment.bundle_adjustment import (
    BundleAdjuster,
    FreeParameters,
    Parameters,
)
from rdstitch.alignment.link_equations import split_lens
from rdstitch.alignment.motion_models import MotionModel
from rdstitch.alignment.observations import Observations
from rdstitch.alignment.priors import Priors
from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.division_model import undistort
from rdstitch.radial_homography import RadialHomography, transfer
from rdstitch.solvers.direct_linear import direct_linear

MAX_ITERATIONS = 24
"""A start need not be the minimum."""


def relations_at(observations: Observations, relations: Sequence[RadialHomography], lens: FloatArray) -> FloatArray:
    """Each link's homography (L, 3, 3) expressed with one common lens.

    A pair's homography belongs to the pair's own λ. Where that differs from the common one, the homography is fitted
    anew (DLT) to the pair's own, outlier-free transfer of its points.
    """
    distortion, higher, center = split_lens(lens)
    result = np.empty((len(relations), 3, 3))
    for link, relation in enumerate(relations):
        result[link] = relation.homography
        if abs(relation.distortion - distortion) < 1e-9 and not center.any() and relation.camera.higher == higher:
            continue
        points1 = observations.points1[observations.start[link] : observations.start[link + 1]]
        own = transfer(relation.homography, relation.distortion, points1, relation.camera.higher)
        x1, x2 = (undistort(points - center, distortion, higher) for points in (points1, own))
        valid = np.isfinite(x1).all(axis=1) & np.isfinite(x2).all(axis=1)
        if valid.sum() >= 4:
            result[link] = direct_linear(x1[valid], x2[valid])
    return result


def independent_pairs(
    model: MotionModel,
    observations: Observations,
    homographies: FloatArray,
    shared: FloatArray,
    lens: FloatArray,
    free_lens: BoolArray,
    priors: Priors,
    attitudes: FloatArray,
) -> tuple[BundleAdjuster, Parameters]:
    """Return the adjustment of every link on its own, with the shared parameters in common, and where it starts.
    Of the links' homographies (L, 3, 3) at this lens, and of tilts that differ from the shared one by attitudes (N, 2),
    radians. Priors on the poses are not used.
    """
    count = 2 * len(observations)
    start = Parameters(nearest_pairs(model, observations, homographies, shared, attitudes), shared, lens)
    known = replace(Priors.none(model, count), shared=priors.shared, lens=priors.lens)
    freedom = FreeParameters.fixing(model, count, list(range(0, count, 2)), free_lens)
    apart = observations.as_independent_pairs()
    return BundleAdjuster(model, apart, freedom, known, max_iterations=MAX_ITERATIONS), start


def nearest_pairs(
    model: MotionModel, observations: Observations, homographies: FloatArray, shared: FloatArray, attitudes: FloatArray
) -> FloatArray:
    """Poses of both images of every link, (2 L, ...), nearest to its homography (L, 3, 3); the first at the origin."""
    tilts = attitudes[np.stack([observations.image1, observations.image2], axis=1)].reshape(-1, 2)
    matrices = model.origins(shared, tilts)
    matrices[1::2] = homographies @ matrices[0::2]
    return model.nearest_poses(matrices, shared, tilts)
