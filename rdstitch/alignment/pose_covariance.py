"""How well the poses are known: covariances of position, height and yaw, from the normal equations of the adjustment.

They are relative to the reference image, whose pose is the frame, with the focal length and the lens as uncertain as
the images leave them. Errors count as independent as the overdispersion of the fit says.
"""

import numpy as np

from rdstitch.alignment.adjustment_problem import Fit, Problem
from rdstitch.alignment.motion_models import LOG_HEIGHT, YAW, PlanarModel, X, Y
from rdstitch.arrays import FloatArray

_COLUMNS = 512  # of the inverse at a time


def pose_covariances(problem: Problem, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Covariances of x, y, height and yaw by a planar fit, in heights of the reference image and radians.

    (N, 4, 4) of each image, zero for the reference; and the same of each image (rows) with the first one (columns).
    """
    adjuster, model, parameters = problem.adjuster_of(fit), fit.model, fit.adjusted.parameters
    assert isinstance(model, PlanarModel)
    normal, free = adjuster.normal_equations(fit.adjusted), adjuster.free.poses
    (count, size), shared = free.shape, len(normal.gradient_shared)
    # Rows of the inverse, of which the pose parameters of the gauge have none.
    row = np.where(free, np.cumsum(free).reshape(free.shape) - 1, -1)
    jacobian = _jacobian(model, parameters.poses, parameters.shared, problem.reference, size + shared)
    nothing = np.zeros((len(normal.gradient_poses), shared))
    by_shared, of_shared = normal.responses(nothing, -np.eye(shared))

    def block(one: int, other: int, poses: FloatArray, columns: dict[int, int]) -> FloatArray:
        """Covariance (D + S, D + S) of two images' parameters, by the columns of the inverse that are the other's."""
        found = np.zeros((size + shared, size + shared))
        found[size:, size:] = of_shared
        rows, across = free[one], free[other]
        found[: len(rows), size:][rows] = by_shared[row[one][rows]]
        found[size:, :size][:, across] = by_shared[row[other][across]].T
        inner = poses[row[one][rows]][:, [columns[k] for k in row[other][across].tolist()]]
        found[:size, :size][np.ix_(rows, across)] = inner
        return found

    own, with_first = np.empty((2, count, 4, 4))
    step = max(1, _COLUMNS // size)
    for start in range(0, count, step):
        images = range(start, min(start + step, count))
        wanted = row[images.start : images.stop][free[images.start : images.stop]]
        gradient = np.zeros((len(nothing), len(wanted)))
        gradient[wanted, np.arange(len(wanted))] = -1.0
        poses = normal.responses(gradient, np.zeros((shared, len(wanted))))[0]
        columns = {int(k): place for place, k in enumerate(wanted)}
        for k in images:
            own[k] = jacobian[k] @ block(k, k, poses, columns) @ jacobian[k].T
            with_first[k] = (jacobian[0] @ block(0, k, poses, columns) @ jacobian[k].T).T
    return own, with_first


def _jacobian(model: PlanarModel, poses: FloatArray, shared: FloatArray, reference: int, size: int) -> FloatArray:
    """Derivatives (N, 4, D + S) of x, y, height and yaw in the frame of the reference."""
    yaw, height = poses[reference, YAW], float(np.exp(poses[reference, LOG_HEIGHT]))
    unit = 1.0 / (height * np.exp(shared[2]))
    turn = unit * np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    jacobian = np.zeros((len(poses), 4, size))
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
