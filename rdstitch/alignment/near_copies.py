"""Images that show almost only what another one shows: each is placed by its links when all else is known."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.alignment_options import AlignmentOptions, GivenImages
from rdstitch.alignment.least_squares.bundle_adjustment import BundleAdjuster, FreeParameters
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.motion_models import PSI, THETA
from rdstitch.alignment.result import Alignment, PlanarPoses
from rdstitch.alignment.uncertainty import pose_jacobian
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.radial_homography import inverses
from rdstitch.robust.priors import exact


def without_measurements(near_copies: Mapping[int, int], options: AlignmentOptions) -> dict[int, int]:
    """The near copies, each with its image, that add nothing.

    The reference, an image with a control point, and one with a position or a gravity that its image has not, do.
    """
    adding = {sighting.image for sighting in options.control} | {options.reference}
    given = [np.asarray(one, dtype=np.float64) for one in (options.positions, options.gravity) if one is not None]
    known = [np.asarray(np.isfinite(one).all(axis=1)) for one in given]
    return {
        copy: first
        for copy, first in near_copies.items()
        if copy not in adding and not any(one[copy] and not one[first] for one in known)
    }


def with_near_copies(
    alignment: Alignment, given: GivenImages, aligned: IntArray, all_links: Problem, fit: Fit
) -> Alignment:
    """The alignment of the images ``aligned`` by ``fit``, with near copies of them; nothing else changes."""
    result = alignment.with_copies(given.near_copies, [link.images for link in alignment.links])
    links = [link for link in given.links_of_copies if result.used[link.image1] and result.used[link.image2]]
    if not links:
        return result
    images = np.flatnonzero(result.used)
    firsts = np.array([given.near_copies.get(k, k) for k in images.tolist()])
    number = np.full(len(result.used), -1, dtype=np.intp)
    number[images] = np.arange(len(images))
    copies: BoolArray = ~np.isin(images, aligned)
    rows, reference = images[copies], int(number[alignment.reference])

    model, start, camera_priors = fit.model, fit.result.parameters, all_links.camera_priors.of(images)
    where = np.searchsorted(aligned, firsts)
    poses = start.poses[where]
    tilted = camera_priors.attitudes - camera_priors.attitudes[number[firsts]]
    poses[copies] = _tilted(fit, where[copies], tilted[copies])
    log_focal = model.log_focal(start.shared) if model.one_camera else None
    priors = camera_priors.priors(model, len(images), fit.tilt_spread or 0.0, log_focal)
    adjuster = BundleAdjuster(
        model,
        Observations.from_links(links, given.cameras).subset(np.arange(len(links)), number),
        FreeParameters(np.repeat(copies[:, None], model.pose_size, axis=1), np.zeros_like(fit.free_lens)),
        replace(priors, shared=tuple(map(exact, model.physical_parameters(start.shared)[0].tolist()))),
        fit.overdispersion,
    )
    adjusted = adjuster.run(replace(start, poses=poses))

    matrices = adjusted.matrices.matrices
    frame = alignment.homographies[alignment.reference] @ matrices[reference]
    result.homographies[rows] = frame @ inverses(matrices[copies])
    if result.poses is not None:
        metric = model.metric_poses(adjusted.parameters.poses, adjusted.parameters.shared)
        placed = PlanarPoses.of(metric).relative_to(reference)
        for name in ("yaw", "position", "height", "tilt"):
            getattr(result.poses, name)[rows] = getattr(placed, name)[copies]
        if result.poses.covariance is not None:  # a copy is as uncertain as its image, and as where it lies beside that
            covariance = adjuster.normal_equations(adjusted).pose_covariances()[0][copies]
            moved = pose_jacobian(model, adjusted.parameters.poses, start.shared, reference)[
                copies, :, : covariance.shape[1]
            ]
            result.poses.covariance[rows] += moved @ covariance @ moved.swapaxes(1, 2)
    return result


def _tilted(fit: Fit, rows: IntArray, by: FloatArray) -> FloatArray:
    """The poses that come nearest to those of a fit in some rows, and are tilted by so much (C, 2) more, radians."""
    model, parameters = fit.model, fit.result.parameters
    poses = parameters.poses[rows]
    if not model.has_metric_poses:
        return poses
    tilts = model.metric_poses(poses, parameters.shared)[:, [PSI, THETA]] + by
    tilts -= model.physical_parameters(parameters.shared)[0][:2]
    return model.nearest_poses(fit.result.matrices.matrices[rows], parameters.shared, tilts)
