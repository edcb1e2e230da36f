"""Global adjustment: all poses, the shared tilt and focal length, and the lens, from all correspondences at once.

Levenberg-Marquardt on a robust loss of the transfer errors in measured pixels, generic in the motion model. The width
of the loss follows the scatter of the errors, from wide to narrow, so that good links are not lost to a rough start.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from rdstitch.alignment.link_equations import LinkEquations, folds, link_equations, squared_lengths, whitened_errors
from rdstitch.alignment.motion_models import ModelMatrices, MotionModel, inverses
from rdstitch.alignment.normal_equations import PoseBlocks, SparseNormalEquations, chain
from rdstitch.alignment.observations import Observations
from rdstitch.alignment.priors import Priors, costs, curvatures, slopes
from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.robust.levenberg_marquardt import MAX_DAMPING, MIN_GAIN, damping_by_gain
from rdstitch.robust.loss import ALIGNMENT_WIDTH, RAYLEIGH_MEDIAN, robust_cost

_MIN_SIGMA = 1e-3
"""Pixels; a smaller one is not measurable, and errors are divided by it."""


WIDEST_START = 0.05
"""Half diagonals: errors that a chain may have gathered before the adjustment, beyond which a link is down-weighted."""


@dataclass(frozen=True)
class Parameters:
    """The unknowns of the adjustment."""

    poses: FloatArray  # (N, ...): in the model's own columns
    shared: FloatArray  # (S,): the model's shared parameters
    lens: FloatArray  # (5,): λ, μ, ν and the shift of the distortion centre, in the half-diagonal frame

    def retract(
        self, model: MotionModel, step_poses: FloatArray, step_shared: FloatArray, free_lens: BoolArray
    ) -> Self:
        """After a step."""
        lens = self.lens.copy()
        size = len(self.shared)
        lens[free_lens] += step_shared[size:]
        return replace(
            self,
            poses=model.retract(self.poses, step_poses),
            shared=self.shared + step_shared[:size],
            lens=lens,
        )


@dataclass(frozen=True)
class FreeParameters:
    """Which parameters are estimated, of the poses (N, D) and of the lens (5,)."""

    poses: BoolArray
    lens: BoolArray

    @classmethod
    def fixing(cls, model: MotionModel, count: int, references: FloatArray | list[int], lens: BoolArray) -> Self:
        """All but the gauge of the reference images, one for each connected part of the graph."""
        poses = np.ones((count, model.pose_size), dtype=np.bool_)
        poses[np.asarray(references, dtype=np.intp)] = ~model.gauge
        return cls(poses, lens)


@dataclass(frozen=True)
class BundleAdjustmentResult:
    """Result of an adjustment."""

    parameters: Parameters
    matrices: ModelMatrices
    homographies: FloatArray  # (L, 3, 3): of each link
    sigma: float  # standard deviation of an error's coordinate, pixels, from the median
    squared: FloatArray  # (M,): ``|r|²`` of each correspondence, px², whitened; inf where it cannot be transferred
    equations: LinkEquations  # at the solution
    # (S', S'): of the model's named parameters and the free parameters of the lens, priors included
    covariance: FloatArray
    converged: bool
    iterations: int


@dataclass(frozen=True)
class _State:
    """Parameters with all that is computed from them."""

    parameters: Parameters
    matrices: ModelMatrices
    homographies: FloatArray
    equations: LinkEquations
    cost: float


_FIRST_DAMPING = 1e-6
"""Of the diagonal of the normal matrix. Focal length and tilts of many images are so weak together that a hundred times
as much held them: of 300 frames the focal length stayed 13 % off, with a standard deviation of 2 %."""

Revision = Callable[["BundleAdjuster", Parameters, float, FloatArray], "BundleAdjuster"]
"""See :meth:`BundleAdjuster.run`."""


@dataclass(frozen=True)
class BundleAdjuster:
    """The adjustment of one set of observations with one model."""

    model: MotionModel
    observations: Observations
    free: FreeParameters
    priors: Priors
    # variance of sums of errors over that of independent ones; weighs the correspondences against the priors
    overdispersion: float = 1.0
    max_iterations: int = 60  # linearizations at most
    min_gain: float = MIN_GAIN  # expected relative fall of the cost that is worth another step

    def run(self, start: Parameters, revise: Revision | None = None) -> BundleAdjustmentResult:
        """Adjust.

        Parameters
        ----------
        start : Parameters
        revise : callable, optional
            Takes the adjuster, a solution, its scatter and its whitened errors (M, 2) to the adjuster to go on with;
            the same one ends the adjustment. Then the loss is as wide in the beginning as most links need, and again
            after each revision; otherwise the scatter of the first errors decides.
        """

        def widest(squared: FloatArray, sigma: float) -> float:
            return max(self._rough_width(squared) if revise else 0.0, ALIGNMENT_WIDTH * sigma)

        squared = self.squared(start)
        sigma = self._sigma(squared)
        adjuster, wide, parameters, total, used = self, widest(squared, sigma), start, 0, 0
        while True:
            last = wide <= ALIGNMENT_WIDTH * sigma * 1.05
            state, iterations, converged = adjuster._descend(parameters, sigma, wide, 12 if last else 4)
            parameters, squared, total, used = (
                state.parameters,
                state.equations.squared,
                total + iterations,
                used + iterations,
            )
            sigma, previous = self._sigma(squared), sigma
            wide = max(wide / 3.0, ALIGNMENT_WIDTH * sigma)
            converged = last and converged and abs(sigma - previous) <= 0.02 * previous
            if converged or used >= self.max_iterations:
                revised = revise(adjuster, parameters, sigma, state.equations.errors) if revise else adjuster
                if revised is adjuster:
                    return adjuster._finished(parameters, sigma, total, converged)
                adjuster, wide, used = revised, widest(squared, sigma), 0

    def squared(self, parameters: Parameters) -> FloatArray:
        """``|r|²`` of each correspondence (M,), px², whitened; inf where it cannot be transferred."""
        homographies = self._of_links(self.model.matrices(parameters.poses, parameters.shared))
        return squared_lengths(whitened_errors(self.observations, homographies, parameters.lens))

    def normal_equations(self, adjusted: BundleAdjustmentResult, width: float | None = None) -> SparseNormalEquations:
        """At a solution, priors included; the ``width`` of the loss, pixels, follows the errors if not given."""
        state = self._evaluate(adjusted.parameters, adjusted.sigma, width or ALIGNMENT_WIDTH * adjusted.sigma)
        return self._normal_equations(state, adjusted.sigma)

    def covariance(self, adjusted: BundleAdjustmentResult) -> FloatArray:
        """Of the named parameters and the free ones of the lens (S', S'), as far as the overdispersion is right."""
        derivative = self.named_parameters(adjusted.parameters.shared)[1]
        covariance = inverse_information(self.normal_equations(adjusted).shared_information())
        named: FloatArray = derivative @ covariance @ derivative.T
        return named

    def _descend(self, parameters: Parameters, sigma: float, width: float, most: int) -> tuple[_State, int, bool]:
        """Levenberg-Marquardt at one width of the loss; the state reached, linearizations, whether converged."""
        state = self._evaluate(parameters, sigma, width)
        damping, failures, used = _FIRST_DAMPING, 0, 1
        while used < most:
            normal = self._normal_equations(state, sigma)
            try:
                flat, step_shared = normal.solve(damping)
            except RuntimeError:  # singular: no correspondence of some images can be transferred
                return state, used, False
            step_poses = np.zeros(self.free.poses.shape)
            step_poses[self.free.poses] = flat
            # The decrease of the quadratic model, less what the damping adds to it.
            predicted = -(normal.gradient_poses @ flat + normal.gradient_shared @ step_shared)
            if not np.isfinite(predicted) or predicted <= self.min_gain * max(state.cost, 1e-12):
                return state, used, True
            parameters_moved = state.parameters.retract(self.model, step_poses, step_shared, self.free.lens)
            used += 1
            moved_state = (
                None
                if folds(parameters_moved.lens, self.observations.reach)
                else self._evaluate(parameters_moved, sigma, width)
            )
            after = np.inf if moved_state is None else self._cost(moved_state, state.equations.whitening, sigma, width)
            damping, failures = damping_by_gain(damping, failures, float((state.cost - after) / predicted))
            if moved_state is not None and after < state.cost:
                state = moved_state
            elif damping > MAX_DAMPING:
                return state, used, True
        return state, used, False

    def _evaluate(self, parameters: Parameters, sigma: float, width: float) -> _State:
        """Errors, cost and linearization at some parameters."""
        matrices = self.model.matrices(parameters.poses, parameters.shared)
        homographies = self._of_links(matrices)
        equations = link_equations(self.observations, homographies, parameters.lens, width, self.free.lens)
        cost = float(robust_cost(equations.squared, width).sum()) * self.weight(sigma)
        return _State(parameters, matrices, homographies, equations, cost + self._prior_cost(parameters))

    def _cost(self, state: _State, whitening: FloatArray, sigma: float, width: float) -> float:
        """The cost of a state with a given whitening."""
        squared = state.equations.squared_with(whitening)
        return float(robust_cost(squared, width).sum()) * self.weight(sigma) + self._prior_cost(state.parameters)

    def _of_links(self, matrices: ModelMatrices) -> FloatArray:
        """``H_ij = P_j P_i⁻¹`` of each link, shape (L, 3, 3)."""
        i, j = self.observations.image1, self.observations.image2
        with np.errstate(all="ignore"):
            product: FloatArray = matrices.matrices[j] @ inverses(matrices.matrices)[i]
        return product

    @cached_property
    def _blocks(self) -> PoseBlocks:
        """The pattern of the normal matrix."""
        return PoseBlocks.of(self.observations, self.free.poses)

    def _rough_width(self, squared: FloatArray) -> float:
        """Width of the loss, pixels, at which most links still count, as far off as a chain may have put them."""
        medians = self.observations.medians(np.sqrt(squared))
        most = 1.5 * float(np.quantile(np.where(np.isfinite(medians), medians, 1e9), 0.95))
        return min(most, WIDEST_START * float(np.median(self.observations.scale2)))

    def _sigma(self, squared: FloatArray) -> float:
        return sigma_of(squared[self.observations.scale_inliers_mask])

    def weight(self, sigma: float) -> float:
        """Of squared errors of this scatter: one over their variance, as far as they are independent."""
        return 1.0 / (sigma**2 * self.overdispersion)

    def camera_prior_cost(self, parameters: Parameters) -> float:
        """-2 log of the prior density of the camera, relative to the largest.

        With a focal length that grows without limit a turn becomes a shift over a plane, and ground a tilt.
        """
        physical = self.model.physical_parameters(parameters.shared)[0]
        return costs(self.priors.shared, physical) + costs(self.priors.lens, parameters.lens)

    def _prior_cost(self, parameters: Parameters) -> float:
        offsets = self.model.prior_coordinates(parameters.poses) - self.priors.poses
        return self.camera_prior_cost(parameters) + float((self.priors.poses_precision * offsets**2).sum())

    def _normal_equations(self, state: _State, sigma: float) -> SparseNormalEquations:
        """Of the data at ``state``, and of the priors."""
        normal = chain(
            state.equations,
            self.observations,
            state.matrices,
            state.homographies,
            self._blocks,
            self.weight(sigma),
        )
        p, free, lens = self.priors, self.free.poses, self.free.lens
        physical, derivative = self.named_parameters(state.parameters.shared)
        slope, precision = (
            np.concatenate([of(p.shared, physical), of(p.lens, state.parameters.lens)[lens]])
            for of in (slopes, curvatures)
        )
        poses = self.model.prior_coordinates(state.parameters.poses) - p.poses
        return normal.with_priors(
            p.poses_precision[free],
            poses[free],
            derivative.T @ (precision[:, None] * derivative),
            derivative.T @ slope,
        )

    def named_parameters(self, shared: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The named parameters (S,), and their derivatives by the shared ones and by the lens (S', S')."""
        physical, derivative = self.model.physical_parameters(shared)
        size, lens = len(physical), int(self.free.lens.sum())
        whole = np.eye(size + lens)
        whole[:size, :size] = derivative
        return physical, whole

    def _finished(self, parameters: Parameters, sigma: float, used: int, converged: bool) -> BundleAdjustmentResult:
        """The result with its covariance."""
        state = self._evaluate(parameters, sigma, ALIGNMENT_WIDTH * sigma)
        derivative = self.named_parameters(parameters.shared)[1]
        covariance = inverse_information(self._normal_equations(state, sigma).shared_information())
        return BundleAdjustmentResult(
            parameters,
            state.matrices,
            state.homographies,
            sigma,
            state.equations.squared,
            state.equations,
            derivative @ covariance @ derivative.T,
            converged,
            used,
        )


def sigma_of(squared: FloatArray) -> float:
    """Standard deviation of an error's coordinate, pixels, from the median of the squared lengths (M,)."""
    if not len(squared):
        return _MIN_SIGMA
    median = float(np.sqrt(np.median(squared)))
    return max(median / RAYLEIGH_MEDIAN, _MIN_SIGMA) if np.isfinite(median) else 1e3


def inverse_information(information: FloatArray) -> FloatArray:
    """Inverse of an information matrix; large, not infinite, for what is not determined."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-12))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    inverse: FloatArray = (vectors / np.maximum(values, 1e-14)) @ vectors.T * np.outer(scale, scale)
    return inverse
