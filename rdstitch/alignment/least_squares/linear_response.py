"""How an adjustment answers small changes of its errors: the linearized M-estimator (Huber 1981, section 6.3).

The estimate is where ``Σ w(r) J'r`` vanishes. When an error changes by a little, w r changes with the derivative of w r
by r, not with w: far errors count less the farther they are. In the normal equations w stands in its place, which is
as good for finding the minimum; for how far the minimum moves, it is too large by what this module calls the curvature.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rdstitch.alignment.least_squares.bundle_adjustment import BundleAdjuster, BundleAdjustmentResult
from rdstitch.alignment.least_squares.link_equations import LinearizedErrors, linearized_errors
from rdstitch.alignment.least_squares.normal_equations import SparseNormalEquations, link_derivatives
from rdstitch.arrays import FloatArray
from rdstitch.numerics.robust_loss import ALIGNMENT_WIDTH, robust_slope, robust_weight

Fields = Callable[[LinearizedErrors], FloatArray]
"""Changes (m, 2, C) of the errors of some links, pixels."""


@dataclass(frozen=True, eq=False)
class LinearResponse:
    """An adjustment, linearized at its solution."""

    adjuster: BundleAdjuster
    result: BundleAdjustmentResult  # of this adjuster, or of one that held a part of the lens
    weight: FloatArray  # (M,): what the square of each error counts in the normal equations
    curvature: float  # mean derivative of ``w r`` by r, in units of the mean of w: between 0 and 1
    normal: SparseNormalEquations  # with the curvature in them

    @classmethod
    def of(cls, adjuster: BundleAdjuster, adjusted: BundleAdjustmentResult) -> Self:
        """The response at a solution."""
        width = ALIGNMENT_WIDTH * adjusted.sigma
        weight = robust_weight(adjusted.squared, width)
        curvature = float(np.clip(robust_slope(adjusted.squared, width).sum() / max(weight.sum(), 1e-300), 0.1, 1.0))
        normal = replace(adjuster, overdispersion=adjuster.overdispersion / curvature).normal_equations(adjusted)
        return cls(adjuster, adjusted, weight * adjuster.weight(adjusted.sigma), curvature, normal)

    def parts(self) -> Iterator[LinearizedErrors]:
        """The errors with their derivatives, some links at a time."""
        adjusted = self.result
        return linearized_errors(
            self.adjuster.observations, adjusted.homographies, adjusted.parameters.lens, self.adjuster.free.lens
        )

    def step(self) -> tuple[FloatArray, FloatArray]:
        """The step of poses (N, D, 1) and shared parameters (S, 1) when what the solution held is free, too."""
        return self.normal.responses(self.normal.gradient_poses[..., None], self.normal.gradient_shared[:, None])

    def steps_of(self, fields: Fields, columns: int) -> tuple[FloatArray, FloatArray]:
        """Steps of poses (N, D, C) and shared parameters (S, C) when the errors change by so many ``fields``."""
        o, (count, size) = self.adjuster.observations, self.adjuster.free.poses.shape
        start, of_poses = o.start, np.zeros((count, size, columns))
        of_shared = np.zeros((len(self.normal.gradient_shared), columns))
        for part in self.parts():
            weighted = fields(part) * (self.curvature * self.weight[part.rows])[:, None, None]
            derivative = self._derivative(part)
            answers = np.empty((*derivative.shape[:2], columns))
            for link in range(part.first, part.last):
                rows = slice(start[link] - part.rows.start, start[link + 1] - part.rows.start)
                jacobian = part.jacobian[rows].reshape(-1, derivative.shape[1])
                answers[link - part.first] = jacobian.T @ weighted[rows].reshape(-1, columns)
            local = np.swapaxes(derivative, 1, 2) @ answers
            for k, images in enumerate((o.image1, o.image2)):
                np.add.at(of_poses, images[part.first : part.last], local[:, k * size : (k + 1) * size])
            of_shared += local[:, 2 * size :].sum(axis=0)
        return self.normal.responses(of_poses, of_shared)

    def changes(self, part: LinearizedErrors, poses: FloatArray, shared: FloatArray) -> FloatArray:
        """Changes of the errors (m, 2, C) with steps of poses (N, D, C) and shared parameters (S, C)."""
        o, columns = self.adjuster.observations, shared.shape[1]
        change, derivative = np.empty((*part.errors.shape, columns)), self._derivative(part)
        for link in range(part.first, part.last):
            rows = slice(o.start[link] - part.rows.start, o.start[link + 1] - part.rows.start)
            steps = np.concatenate([poses[o.image1[link]], poses[o.image2[link]], shared])
            change[rows] = part.jacobian[rows] @ (derivative[link - part.first] @ steps)
        return change

    def _derivative(self, part: LinearizedErrors) -> FloatArray:
        """Derivatives of some links' homographies and the free lens, see :func:`link_derivatives`."""
        adjusted, links = self.result, slice(part.first, part.last)
        lens_count = int(self.adjuster.free.lens.sum())
        return link_derivatives(self.adjuster.observations, adjusted.matrices, adjusted.homographies, lens_count, links)
