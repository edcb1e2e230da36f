"""How well lens and poses are known: where errors are no independent noise, and by what was not estimated.

The inverse of the normal equations takes errors for independent. They are not, in three ways. A keypoint that several
pairs share brings its error into all of them. Relief moves all points of a place together, in every pair of images
that shows it; see :mod:`rdstitch.alignment.relief_field`. A rolling shutter, or a lens that changes, moves all points
of an image. The influence of each correspondence on λ is added up per keypoint, or per image, and the sums are
squared: a sandwich estimate (Huber 1981; Cameron and Miller 2015). Poses are relative to the reference image, whose own
is the frame, with the focal length and the lens as uncertain as the images leave them; there errors count as
independent as the overdispersion of the fit says.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.least_squares.bundle_adjustment import (
    BundleAdjuster,
    BundleAdjustmentResult,
    inverse_information,
)
from rdstitch.alignment.least_squares.linear_response import LinearResponse
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.least_squares.plane_marks import PlaneMarks
from rdstitch.alignment.motion_models import HOMOGRAPHY, LOG_HEIGHT, YAW, MotionModel, X, Y
from rdstitch.alignment.relief_field import ReliefField
from rdstitch.alignment.select import Posterior
from rdstitch.alignment.starts import fit_model
from rdstitch.arrays import FloatArray, IntArray
from rdstitch.choices import Purpose
from rdstitch.robust.covariance import enlarged
from rdstitch.robust.posterior import MODEL_ERROR
from rdstitch.robust.priors import LENS_PRIORS

_ENOUGH = 6000  # matches in all that say how high and how wide the hills are
_MIN_MATCHES_PER_LINK = 20  # matches of each link at least
_UNLIKELY_FOCAL = 4.0
"""Standard deviations of what is known of a focal length beyond which it may stand for something else."""

_SINGULAR = 1e-12  # least eigenvalue of a correlation matrix of parameters


def covariances(problem: Problem, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Covariance (P, P) of the model's named parameters and the free ones of the lens, and (5, 5) of all of a lens.

    Also of those that were not freed: consider parameters (Schmidt 1966). That a lens of fewer parameters explains the
    images does not make it the lens: what they leave open of the others, within what lenses usually have, moves λ where
    these images show nothing.
    """
    free_every, named = replace(problem, free_lens=np.ones_like(problem.free_lens)), len(fit.model.shared_names)
    every = np.arange(named + len(problem.free_lens))
    estimated = every[np.concatenate([np.ones(named, dtype=np.bool_), problem.free_lens])]
    of_estimated, considered = sandwich_covariances(free_every.adjuster_of(fit), fit.result, (estimated, every))
    if problem.free_lens.any():  # what is left open of the lens moves tilt and focal length, too
        ratio = np.diag(considered)[:named] / np.maximum(np.diag(of_estimated)[:named], 1e-300)
        grown = np.append(np.sqrt(np.maximum(ratio, 1.0)), np.ones(len(of_estimated) - named))
        of_estimated = grown[:, None] * of_estimated * grown
    return of_estimated, considered[named:, named:]


def sandwich_covariances(
    adjuster: BundleAdjuster, adjusted: BundleAdjustmentResult, parts: Sequence[IntArray]
) -> list[FloatArray]:
    """Covariance (P, P) of each part of the model's named parameters and the free ones of the lens, the rest held.

    In no direction less than that of independent errors, nor than where errors agree within images.
    """
    response, observations = LinearResponse.of(adjuster, adjusted), adjuster.observations
    influence, priors = _influence(response)
    by_images = priors + _by_images(observations, influence)
    count = int(adjuster.free.poses.sum()) + influence.shape[1]
    errors = 2 * int((response.weight > 0.0).sum())
    absorbed = errors / max(errors - count, 0.25 * errors)
    noise = absorbed * _by_keypoints(observations, influence)
    information = response.normal.shared_information()
    del response, influence  # which take as much memory as what follows
    by_relief = _relief(adjuster, adjusted).steps()[1]
    correlated = _at_least(priors + noise + by_relief @ by_relief.T, by_images)
    independent = replace(adjuster, overdispersion=1.0).normal_equations(adjusted).shared_information()
    derivative = adjuster.named_parameters(adjusted.parameters.shared)[1]
    result = []
    for part in parts:
        block = np.ix_(part, part)
        # What moves all parameters moves the part as this says, where the rest is held.
        moved = derivative[block] @ inverse_information(information[block]) @ information[part]
        alone = derivative[block] @ inverse_information(independent[block]) @ derivative[block].T
        result.append(_at_least(alone, moved @ correlated @ moved.T))
    return result


def _relief(adjuster: BundleAdjuster, adjusted: BundleAdjustmentResult) -> ReliefField:
    """What relief does, by as many matches of each link as show its waves."""
    observations = adjuster.observations
    few = observations.thinned(max(_ENOUGH // max(len(observations), 1), _MIN_MATCHES_PER_LINK))
    fraction = len(few.points1) / max(len(observations.points1), 1)
    if fraction < 1.0:  # each counts for several beside the priors
        adjuster = replace(adjuster, observations=few, overdispersion=adjuster.overdispersion * fraction)
        adjusted = replace(adjusted, adjuster=adjuster)
    return ReliefField(LinearResponse.of(adjuster, adjusted))


def _influence(response: LinearResponse) -> tuple[FloatArray, FloatArray]:
    """Influence of each correspondence on the shared parameters (M, S'), and their covariance by the priors alone."""
    normal = response.normal
    count = len(normal.gradient_shared)
    poses, shared = normal.responses(np.zeros_like(normal.coupling), -np.eye(count))
    influence, information = np.empty((len(response.weight), count)), np.zeros((count, count))
    for part in response.parts():
        change, weight = response.changes(part, poses, shared), response.weight[part.rows]
        influence[part.rows] = weight[:, None] * np.einsum("mi,mic->mc", part.errors, change)
        rows = change.reshape(-1, count)
        information += response.curvature * (rows.T * np.repeat(weight, 2)) @ rows
    return influence, shared - information


def _at_least(covariance: FloatArray, other: FloatArray) -> FloatArray:
    """The covariance (S, S), in no direction less than another, which may be singular."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    values = np.maximum(values, _SINGULAR)
    root, inverse = vectors * np.sqrt(values) * scale[:, None], vectors / np.sqrt(values) / scale[:, None]
    return enlarged(root, inverse.T @ other @ inverse)


def _by_keypoints(observations: Observations, influence: FloatArray) -> FloatArray:
    """Covariance (S, S) when errors of correspondences that share a keypoint agree, by the influence (M, S) of each."""
    images = np.concatenate([observations.image1, observations.image2])
    independent = influence.T @ influence
    shared = -independent  # each correspondence is among those of two keypoints
    # One image after the other: all keypoints at once would be most of the memory of an alignment.
    for ends in np.split(np.argsort(images, kind="stable"), np.cumsum(np.bincount(images))[:-1]):
        sides, links = np.divmod(ends, len(observations))
        rows = [np.arange(observations.start[link], observations.start[link + 1]) for link in links.tolist()]
        points = [
            (observations.points2 if side else observations.points1)[of_link]
            for side, of_link in zip(sides.tolist(), rows, strict=True)
        ]
        if not points:
            continue
        x, y = np.concatenate(points).T
        keypoint = np.unique(x + 1j * y, return_inverse=True)[1].reshape(-1)
        sums = np.zeros((len(keypoint), influence.shape[1]))
        np.add.at(sums, keypoint, influence[np.concatenate(rows)])
        shared = shared + sums.T @ sums
    return _at_least(independent, shared)


def _by_images(observations: Observations, influence: FloatArray) -> FloatArray:
    """Covariance (S, S) when errors of links that share an image agree: dyadic clusters (Aronow et al. 2015)."""
    count = 1 + int(max(observations.image1.max(), observations.image2.max()))
    link, image = np.zeros((len(observations), influence.shape[1])), np.zeros((count, influence.shape[1]))
    np.add.at(link, observations.link, influence)
    for images in (observations.image1, observations.image2):
        np.add.at(image, images, link)
    return image.T @ image - link.T @ link


def considered_covariance(problem: Problem, fit: Fit, covariance: FloatArray, *, over_relief: bool) -> FloatArray:
    """The covariance (5, 5) of all parameters of a lens with what a wrong model of the motion does to them.

    A focal length that next to no lens has bends the images with something else, and λ may be what goes with the usual
    one. Over relief that is known, and in the covariance.
    """
    count, deviation = len(problem.free_lens), 0.0
    if fit.model.has_metric_poses:
        log_focal = fit.model.log_focal(fit.result.parameters.shared)
        deviation = log_focal - problem.camera_priors.log_focal
    if not over_relief and abs(deviation) > _UNLIKELY_FOCAL * problem.camera_priors.log_focal_std:
        adjuster = replace(problem, free_lens=np.ones_like(problem.free_lens)).adjuster_of(fit)
        together = adjuster.covariance(fit.result)
        focal = len(fit.model.shared_names) - 1
        moved = together[-count:, focal] * (deviation / together[focal, focal])
        covariance = covariance + np.outer(moved, moved)
    if problem.count == 2 and fit.model.has_metric_poses:
        covariance = _with_free_motion(problem, fit, covariance, over_relief=over_relief)
    return covariance


def _with_free_motion(problem: Problem, fit: Fit, covariance: FloatArray, *, over_relief: bool) -> FloatArray:
    """The covariance (5, 5) over two models: the one taken, and a homography (Buckland, Burnham and Augustin 1997).

    Of two images nothing but their errors says whether they were tilted alike, and over rough ground they say little.
    Each model counts as much as Schwarz's criterion makes it likely.
    """
    free = fit_model(problem, HOMOGRAPHY)
    posterior = Posterior(problem, Purpose.TRAJECTORY)
    against = float(np.clip((posterior.hypothesis(free).cost - posterior.hypothesis(fit).cost) / 2.0, -50.0, 50.0))
    of_free = 1.0 / (1.0 + math.exp(against))
    off = free.result.parameters.lens - fit.result.parameters.lens
    other = considered_covariance(problem, free, covariances(problem, free)[1], over_relief=over_relief)
    return (1.0 - of_free) * covariance + of_free * (other + np.outer(off, off))


def weigh_lens(problem: Problem, fit: Fit, covariance: FloatArray) -> Fit:
    """λ where its prior and its uncertainty, last in the covariance, put it, and everything else adjusted to that.

    The adjustment takes errors for independent, and so its data for surer than they are: where two images show depth,
    they would be believed a fisheye. A lens of more parameters is only chosen where images show it.
    """
    if problem.free_lens.sum() != 1:
        return fit
    parameters, prior = fit.result.parameters, LENS_PRIORS[0]
    value = float(parameters.lens[0])
    # What the images say without the prior, which has had its part in the adjustment: the value and its variance.
    total = 1.0 / float(problem.adjuster_of(fit).covariance(fit.result)[-1, -1])
    of_prior = prior.curvature(value)
    of_data = max(total - of_prior, 1e-9 * total)  # information
    variance = max(float(covariance[-1, -1]) - of_prior / total**2, 1.0 / total) * (total / of_data) ** 2
    weighed = prior.combined(value + prior.slope(value) / of_data, math.sqrt(variance))
    if abs(weighed - value) * float(np.median(problem.observations.scale1)) < MODEL_ERROR:
        return fit
    fixed = replace(problem, free_lens=np.zeros_like(problem.free_lens))
    lens = np.where(problem.free_lens, weighed, parameters.lens)
    adjusted = fixed.refine(fit.model, replace(parameters, lens=lens), fit.tilt_spread).result
    # λ was held at a weighed value to adjust the rest; it is estimated all the same.
    return replace(fit, result=replace(adjusted, adjuster=problem.adjuster_of(fit)))


def lever_std(problem: Problem, fit: Fit) -> float:
    """How far relief moves the ground in the middle of an image against the nadir below the camera, by a planar fit.

    Standard deviation of a coordinate, in heights of the reference image: tilts that grow along a flight over hills put
    all nadirs right, and make the ground larger or smaller.
    """
    adjuster, parameters, model = problem.adjuster_of(fit), fit.result.parameters, fit.model
    steps_of_poses, steps_of_shared = _relief(adjuster, fit.result).steps()
    size, images = model.pose_size, np.arange(problem.count)
    focal = model.focal(parameters.shared)
    middles = PlaneMarks(images, np.zeros((len(images), 2)), np.zeros((len(images), 2)), np.ones(len(images)))
    derivative = middles.equations(fit.result.matrices, parameters.lens, adjuster.free.lens, focal)[1]
    derivative[:, [0, 1], [model.free.index(column) for column in (X, Y)]] -= 1.0
    moved = derivative[:, :, size:] @ steps_of_shared
    moved += derivative[:, :, :size] @ steps_of_poses
    unit = focal * float(np.exp(parameters.poses[problem.reference, LOG_HEIGHT]))
    return float(np.sqrt((moved**2).sum(axis=2).mean())) / unit


def pose_covariances(problem: Problem, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Covariances of x, y, height and yaw by a planar fit, in heights of the reference image and radians.

    (N, 4, 4) of each image, zero for the reference; and the same of each image (rows) with the first one (columns).
    """
    if problem.free_lens.any():  # what is left open of the lens moves them, too
        problem = replace(problem, free_lens=np.ones_like(problem.free_lens))
    adjuster, model, parameters = problem.adjuster_of(fit), fit.model, fit.result.parameters
    normal, (count, size) = adjuster.normal_equations(fit.result), adjuster.free.poses.shape
    of_pose, by_shared, of_shared = normal.pose_covariances()
    of_first = np.zeros((count, size, size))
    of_first[0] = np.eye(size)
    first = normal.responses(-of_first, np.zeros((len(of_shared), size)))[0]

    def joint(poses: FloatArray, other: FloatArray) -> FloatArray:
        """Covariances (N, D + S, D + S) of all parameters of an image with those of another one."""
        shared = np.broadcast_to(of_shared, (count, *of_shared.shape))
        return np.block([[poses, by_shared], [other.swapaxes(1, 2), shared]])

    jacobian = pose_jacobian(model, parameters.poses, parameters.shared, problem.reference)
    jacobian = np.pad(jacobian, ((0, 0), (0, 0), (0, size + len(of_shared) - jacobian.shape[2])))  # by the lens
    relief = _relief(adjuster, fit.result)
    # A lens that was held, although the images show more of it, has moved the poses by the step to the freed one.
    steps_of_poses, steps_of_shared = (
        np.concatenate(steps, axis=-1) for steps in zip(relief.steps(), relief.response.step(), strict=True)
    )
    by_shared_steps = np.broadcast_to(steps_of_shared, (count, *steps_of_shared.shape))
    moved = jacobian @ np.concatenate([steps_of_poses, by_shared_steps], axis=1)
    of_images = jacobian @ joint(of_pose, by_shared) @ jacobian.transpose(0, 2, 1)
    with_first = jacobian @ joint(first, np.broadcast_to(by_shared[0], by_shared.shape)) @ jacobian[0].T
    return of_images + moved @ moved.transpose(0, 2, 1), with_first + moved @ moved[0].T


def pose_jacobian(model: MotionModel, poses: FloatArray, shared: FloatArray, reference: int) -> FloatArray:
    """Derivatives (N, 4, D + S) of x, y, height and yaw in the frame of the reference."""
    yaw, height = poses[reference, YAW], float(np.exp(poses[reference, LOG_HEIGHT]))
    unit = 1.0 / (height * model.focal(shared))
    turn = unit * np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    jacobian = np.zeros((len(poses), 4, model.pose_size + len(shared)))
    for place, column in enumerate(model.free):
        if column in (X, Y):
            jacobian[:, :2, place] = turn[:, column - X]
        elif column == LOG_HEIGHT:
            jacobian[:, 2, place] = np.exp(poses[:, LOG_HEIGHT]) / height
        elif column == YAW:
            jacobian[:, 3, place] = 1.0
    # Positions are multiplied by the focal length in the adjustment.
    jacobian[:, :2, model.pose_size + 2] = -(poses[:, [X, Y]] - poses[reference, [X, Y]]) @ turn.T
    return jacobian
