"""Where a model is adjusted from: chained links, a plane's metric found in them, or a less free model's solution."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.least_squares.bundle_adjustment import WIDEST_START, Parameters
from rdstitch.alignment.metric_upgrade import metric_upgrade
from rdstitch.alignment.motion_models import SIMILARITY, MotionModel
from rdstitch.alignment.pairwise import best_trial, nearest_pairs
from rdstitch.arrays import FloatArray
from rdstitch.geometry.radial_homography import inverses
from rdstitch.matching.match_graph import SpanningTree, spanning_tree
from rdstitch.numerics.robust_loss import robust_cost

_LONG_CHAIN = 60  # images over which chained homographies drift so far that a planar model is the better start


def fit_model(
    problem: Problem, model: MotionModel, others: Sequence[Fit] = (), shared: FloatArray | None = None
) -> Fit:
    """Adjust a model from the chained links or from the solution of a less free model, whichever is nearer.

    The links start from ``shared`` parameters where these are known, otherwise from the best of several.
    """
    if not others and not model.one_camera and problem.count > _LONG_CHAIN:
        others = [fit_model(problem, SIMILARITY)]
    starts = [start_from(problem, model, other) for other in others]
    if model.any_tilt:
        starts.append(_upgraded(problem, model))
    elif not (others and model.free_tilts):
        starts.append(_chained(problem, model, others, shared))
    return problem.refine(model, _nearest(problem, model, starts))


def start_from(problem: Problem, model: MotionModel, other: Fit) -> Parameters:
    """Another model's solution as this model's start."""
    at = other.result.parameters
    poses = model.poses_from(other.model, at.poses, at.shared, problem.camera_priors.attitudes)
    return replace(at, poses=poses, shared=at.shared if model.one_camera else np.empty(0))


def _tree(problem: Problem) -> SpanningTree:
    """The spanning tree of the links trusted most, from the reference."""
    o = problem.observations
    return spanning_tree(problem.count, o.image1, o.image2, problem.trust, problem.reference)


def _chained(problem: Problem, model: MotionModel, others: Sequence[Fit], start: FloatArray | None) -> Parameters:
    """Every link on its own, chained along the tree of the links trusted most."""
    attitudes, shared, homographies = problem.camera_priors.attitudes, np.zeros(0), problem.homographies
    if model.one_camera:
        shared, homographies = _one_camera_links(problem, SIMILARITY if model.free_tilts else model, others, start)
    tree = _tree(problem)
    origin = model.nominal_homographies(shared, attitudes[[tree.root]])[0]
    chained = tree.chained(homographies, problem.observations.image1, origin)
    return Parameters(model.nearest_poses(chained, shared, attitudes), shared, problem.lens)


def _upgraded(problem: Problem, model: MotionModel) -> Parameters:
    """Chained homographies with the metric of the plane that makes them images of one camera."""
    prior, tree = problem.camera_priors, _tree(problem)
    chained = tree.chained(problem.homographies, problem.observations.image1, np.eye(3))
    poses, physical = metric_upgrade(chained, tree.root, prior.log_focal, prior.log_focal_std)
    return Parameters(poses, model.shared_from_physical(physical), problem.lens)


def _one_camera_links(
    problem: Problem, model: MotionModel, others: Sequence[Fit], shared: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Shared parameters, and with these the homographies (L, 3, 3) under one camera that are nearest to the links.

    The parameters are those given, those of another planar model, or the best of several.
    """
    planar = [other for other in others if other.model.one_camera]
    if shared is None and planar:
        shared = planar[-1].result.parameters.shared
    elif shared is None:
        adjuster, at = best_trial(problem, model)
        shared = (at if len(problem.observations) == 1 else adjuster.run(at).parameters).shared
    matrices = model.matrices(nearest_pairs(problem, model, shared), shared).matrices
    return shared, matrices[1::2] @ inverses(matrices[0::2])


def _nearest(problem: Problem, model: MotionModel, starts: Sequence[Parameters]) -> Parameters:
    """The start with the smallest errors, those far away counting alike."""
    if len(starts) == 1:
        return starts[0]
    adjuster = problem.adjuster(model)
    width = WIDEST_START * float(np.median(problem.observations.scale2))
    return min(starts, key=lambda start: float(robust_cost(adjuster.squared(start), width).sum()))
