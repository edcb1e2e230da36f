"""Every link on its own: what is wrong with a link, and which lens all have in common, shows nowhere else."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rdstitch.alignment.adjustment_problem import LinkProblem, Problem
from rdstitch.alignment.least_squares.bundle_adjustment import (
    LOOSE_GAIN,
    BundleAdjuster,
    BundleAdjustmentResult,
    FreeParameters,
    Parameters,
)
from rdstitch.alignment.least_squares.link_equations import split_lens
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.motion_models import HOMOGRAPHY, MotionModel
from rdstitch.arrays import FloatArray, evenly_spaced
from rdstitch.geometry.division_model import undistort
from rdstitch.geometry.radial_homography import RadialHomography, transfer
from rdstitch.numerics.robust_loss import ALIGNMENT_WIDTH, robust_cost, sigma_of
from rdstitch.solvers.homography import direct_linear

_MAX_ITERATIONS = 24  # a start need not be the minimum
_TRIAL_LINKS = 30  # links that the shared parameters to start from are tried on
_TRIAL_MATCHES = 40  # matches of each of them


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
        transferred = transfer(relation.homography, relation.distortion, points1, relation.camera.higher)
        x1, x2 = (undistort(points - center, distortion, higher) for points in (points1, transferred))
        valid = np.isfinite(x1).all(axis=1) & np.isfinite(x2).all(axis=1)
        if valid.sum() >= 4:
            result[link] = direct_linear(x1[valid], x2[valid])
    return result


def independent_pairs(links: LinkProblem, model: MotionModel, shared: FloatArray) -> tuple[BundleAdjuster, Parameters]:
    """Return the adjustment of every link on its own, with the shared parameters in common, and where it starts.

    Of what is known of the camera, attitudes are taken as exact, and nothing of the poses besides.
    """
    first = 2 * np.arange(len(links.observations))
    start = Parameters(nearest_pairs(links, model, shared), shared, links.lens)
    freedom = FreeParameters.fixing(model, 2 * len(first), first, links.free_lens)
    pairs = replace(links.observations, image1=first, image2=first + 1)
    priors = links.camera_priors.of_camera(model, 2 * len(first))
    return BundleAdjuster(model, pairs, freedom, priors, max_iterations=_MAX_ITERATIONS), start


def nearest_pairs(links: LinkProblem, model: MotionModel, shared: FloatArray) -> FloatArray:
    """Poses of both images of every link, (2 L, ...), nearest to its homography; the first at the origin."""
    images = np.stack([links.observations.image1, links.observations.image2], axis=1)
    tilts = links.camera_priors.attitudes[images].reshape(-1, 2)
    matrices = model.nominal_homographies(shared, tilts)
    matrices[1::2] = links.homographies @ matrices[0::2]
    return model.nearest_poses(matrices, shared, tilts)


def pairwise_homographies(links: LinkProblem) -> BundleAdjustmentResult:
    """Every link on its own with a homography."""
    adjuster, start = independent_pairs(links, HOMOGRAPHY, np.empty(0))
    return adjuster.run(start)


def best_trial(links: LinkProblem, model: MotionModel) -> tuple[BundleAdjuster, Parameters]:
    """The adjuster of a few links on their own, from the shared parameters nearest to them without adjustment."""
    priors, few = links.camera_priors, evenly_spaced(len(links.observations), _TRIAL_LINKS)
    sample = links.observations.subset(few).thinned(_TRIAL_MATCHES)
    trial = LinkProblem(sample, links.homographies[few], links.lens, links.free_lens, priors)
    starts = model.shared_starts(priors.log_focal, priors.tilt, tilt_known=priors.tilt_known)
    trials = [independent_pairs(trial, model, shared) for shared in starts]
    squared = [adjuster.squared(start) for adjuster, start in trials]
    width = ALIGNMENT_WIDTH * min(float(np.median(sample.scale2)), *map(sigma_of, squared))
    adjuster, start = trials[int(np.argmin([robust_cost(each, width).sum() for each in squared]))]
    return replace(adjuster, min_gain=LOOSE_GAIN), start


def fit_pairwise(problem: Problem, model: MotionModel) -> tuple[BundleAdjustmentResult, FloatArray]:
    """All links on their own under one camera, and the shared parameters where a few of them have put its start."""
    adjuster, start = best_trial(problem, model)
    shared = adjuster.run(start).parameters.shared
    adjuster, start = independent_pairs(problem, model, shared)
    return replace(adjuster, min_gain=problem.min_gain).run(start), shared
