"""Global adjustment: all poses, the shared tilt and focal length, and the lens, from all correspondences at once.

Levenberg-Marquardt on a robust loss of the transfer errors in measured pixels, generic in the motion model. The width
of the loss follows the scatter of the errors, from wide to narrow, so that good links are not lost to a poor start.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from rdstitch.alignment.least_squares.link_equations import (
    LinkEquations,
    folds,
    link_equations,
    squared_lengths,
    trial_errors,
    whitened_errors,
)
from rdstitch.alignment.least_squares.normal_equations import ImageEquations, SparseNormalEquations, assemble
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.least_squares.priors import Priors
from rdstitch.alignment.motion_models import ModelMatrices, MotionModel
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.radial_homography import inverses
from rdstitch.numerics.robust_loss import ALIGNMENT_WIDTH, robust_cost
from rdstitch.robust.levenberg_marquardt import MAX_DAMPING, damping_by_gain
from rdstitch.robust.priors import prior_costs, prior_slopes

MIN_GAIN = 1e-5
"""Expected relative fall of the loss that is worth another step: a hundredth of the noise."""

FEW_GAIN = 1e-4  # the same of a few matches of each pair
LOOSE_GAIN = 1e-3  # the same where another descent goes on from there
WIDEST_START = 0.05
"""Half diagonals: errors that a chain may have gathered before the adjustment, beyond which a link is down-weighted."""


@dataclass(frozen=True, eq=False)
class Parameters:
    """The unknowns of the adjustment."""

    poses: FloatArray  # (N, ...): in the model's own columns
    shared: FloatArray  # (S,): the model's shared parameters
    lens: FloatArray  # (5,): λ, μ, ν and the shift of the distortion centre, in the half-diagonal frame

    def retract(
        self, model: MotionModel, step_poses: FloatArray, step_shared: FloatArray, free_lens: BoolArray
    ) -> Self:
        """The parameters after a step."""
        lens = self.lens.copy()
        size = len(self.shared)
        lens[free_lens] += step_shared[size:]
        return replace(
            self, poses=model.retract(self.poses, step_poses), shared=self.shared + step_shared[:size], lens=lens
        )


@dataclass(frozen=True, eq=False)
class FreeParameters:
    """Which parameters are estimated, of the poses (N, D) and of the lens (5,)."""

    poses: BoolArray
    lens: BoolArray

    @classmethod
    def fixing(cls, model: MotionModel, count: int, references: IntArray | list[int], lens: BoolArray) -> Self:
        """All but the gauge of the reference images, one for each connected part of the graph."""
        poses = np.ones((count, model.pose_size), dtype=np.bool_)
        poses[np.asarray(references, dtype=np.intp)] = ~model.gauge
        return cls(poses, lens)


@dataclass(frozen=True)
class BundleAdjustmentResult:
    """Result of an adjustment."""

    adjuster: "BundleAdjuster"
    parameters: Parameters
    sigma: float  # standard deviation of an error's coordinate, pixels, from the median
    converged: bool
    iterations: int

    @cached_property
    def matrices(self) -> ModelMatrices:
        """Homographies of the images, with their derivatives."""
        return self.adjuster.model.matrices(self.parameters.poses, self.parameters.shared)

    @cached_property
    def homographies(self) -> FloatArray:
        """Homographies (L, 3, 3) of the links."""
        return self.adjuster.of_links(self.matrices)

    @cached_property
    def errors(self) -> FloatArray:
        """Errors of the correspondences (M, 2), pixels, whitened; NaN where one cannot be transferred."""
        return whitened_errors(self.adjuster.observations, self.homographies, self.parameters.lens)

    @property
    def bare(self) -> Self:
        """The result without errors and matrices, which take more memory than the rest; they can be computed again."""
        return replace(self)

    @property
    def squared(self) -> FloatArray:
        """``|r|²`` of each correspondence (M,), px²; inf where it cannot be transferred."""
        return squared_lengths(self.errors)

    @property
    def inliers(self) -> BoolArray:
        """Correspondences (M,) that the adjustment explains."""
        return self.squared <= (ALIGNMENT_WIDTH * self.sigma) ** 2

    @property
    def equations(self) -> LinkEquations:
        """Errors of the links, linearized at the solution."""
        return self.adjuster.linearized(self.parameters, ALIGNMENT_WIDTH * self.sigma).equations

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance (S', S') of the model's named parameters and the free ones of the lens, priors included."""
        return self.adjuster.covariance(self)


@dataclass(frozen=True, eq=False)
class _State:
    """Parameters with the linearization at them."""

    parameters: Parameters
    matrices: ModelMatrices
    homographies: FloatArray
    equations: LinkEquations


@dataclass(frozen=True, eq=False)
class _Descent:
    """Where a descent has led."""

    parameters: Parameters
    errors: FloatArray  # (M, 2): whitened as the last linearization has it, pixels; NaN where there is no transfer
    damping: float
    iterations: int
    converged: bool


_STEPS = 4  # linearizations at one width of the loss
_LAST_STEPS = 12  # linearizations at the last width
_NARROWING = 3.0  # factor by which the loss narrows from one width to the next
_NARROW = 1.05  # ratio to the width that the scatter asks for, up to which a width is the last one
_SETTLED = 0.02  # relative change of the errors' standard deviation that is none

_FIRST_DAMPING = 1e-6
"""Of the diagonal of the normal matrix. Focal length and tilts of many images are so weak together that a hundred times
as much held them: of 300 frames the focal length stayed 13 % off, with a standard deviation of 2 %."""


@dataclass(frozen=True)
class BundleAdjuster:
    """The adjustment of one set of observations with one model."""

    model: MotionModel
    observations: Observations
    free: FreeParameters
    priors: Priors
    # variance of sums of errors over that of independent ones; weighs the correspondences against the priors
    overdispersion: float = 1.0
    max_iterations: int = 60  # linearizations and steps that fail, after which no other width of the loss is tried
    min_gain: float = MIN_GAIN  # expected relative fall of the cost that is worth another step

    def run(self, start: Parameters, *, wide_start: bool = False) -> BundleAdjustmentResult:
        """Adjust.

        With a ``wide_start`` the loss is as wide in the beginning as most links need; otherwise the scatter of the
        first errors decides.
        """
        squared = self.squared(start)
        half_diagonal = float(np.median(self.observations.scale2))  # of errors from which a descent may find back
        sigma = min(self.observations.sigma(squared), half_diagonal)
        damping, parameters, iterations = _FIRST_DAMPING, start, 0
        width = max(self._wide_width(squared) if wide_start else 0.0, ALIGNMENT_WIDTH * sigma)
        while True:
            last = width <= ALIGNMENT_WIDTH * sigma * _NARROW
            descent = self._descend(parameters, sigma, width, damping, _LAST_STEPS if last else _STEPS)
            parameters, damping = descent.parameters, descent.damping
            iterations += descent.iterations
            squared, previous = squared_lengths(descent.errors), sigma
            scatter = self.observations.sigma(squared)
            sigma = min(scatter, half_diagonal)
            width = max(width / _NARROWING, ALIGNMENT_WIDTH * sigma)
            settled = abs(sigma - previous) <= _SETTLED * previous and np.isfinite(scatter)
            converged = bool(last and descent.converged and settled)
            if converged or iterations >= self.max_iterations:
                return BundleAdjustmentResult(self, parameters, sigma, converged, iterations)

    def squared(self, parameters: Parameters) -> FloatArray:
        """``|r|²`` of each correspondence (M,), px², whitened; inf where it cannot be transferred."""
        return squared_lengths(whitened_errors(self.observations, self._homographies(parameters), parameters.lens))

    def normal_equations(self, adjusted: BundleAdjustmentResult, width: float | None = None) -> SparseNormalEquations:
        """Normal equations at a solution, with priors; ``width`` of the loss, pixels, by the errors if not given."""
        state = self.linearized(adjusted.parameters, width or ALIGNMENT_WIDTH * adjusted.sigma)
        return self._normal_equations(state, adjusted.sigma)

    def covariance(self, adjusted: BundleAdjustmentResult) -> FloatArray:
        """Covariance (S', S') of the named and the free lens parameters, as far as the overdispersion is right."""
        derivative = self.named_parameters(adjusted.parameters.shared)[1]
        covariance = inverse_information(self.normal_equations(adjusted).shared_information())
        named: FloatArray = derivative @ covariance @ derivative.T
        return named

    def _descend(self, parameters: Parameters, sigma: float, width: float, damping: float, max_steps: int) -> _Descent:
        """Levenberg-Marquardt at one width of the loss, in at most so many linearizations and steps that fail."""
        steps, failures, moved, converged = 1, 0, True, False
        while steps < max_steps:
            if moved:
                state, moved = self.linearized(parameters, width), False
                normal, errors = self._normal_equations(state, sigma), state.equations.errors
                cost = self._cost(parameters, errors, sigma, width)
            try:
                step_poses, step_shared = normal.solve(damping)
            except np.linalg.LinAlgError:  # no correspondence of some images can be transferred
                break
            # The decrease of the quadratic model, less what the damping adds to it.
            predicted = -(np.vdot(normal.gradient_poses, step_poses) + normal.gradient_shared @ step_shared)
            if not np.isfinite(predicted):
                break
            if predicted <= self.min_gain * max(cost, 1e-12):
                if converged := bool(failures or damping <= _FIRST_DAMPING):
                    break
                damping = _FIRST_DAMPING  # steps that an earlier damping makes short show no minimum
                continue
            trial, after = parameters.retract(self.model, step_poses, step_shared, self.free.lens), np.inf
            if not folds(trial.lens, self.observations.reach):
                homographies = self._homographies(trial)
                trial_error = trial_errors(self.observations, homographies, trial.lens, state.equations.whitening)
                after = self._cost(trial, trial_error, sigma, width)
            steps += 1
            damping, failures = damping_by_gain(damping, failures, float((cost - after) / predicted))
            if after < cost:
                parameters, errors, moved = trial, trial_error, True
            elif damping > MAX_DAMPING:
                break
        return _Descent(parameters, errors, damping, steps, converged)

    def linearized(self, parameters: Parameters, width: float) -> _State:
        """The errors at some parameters, linearized and weighted by a loss of this width, pixels."""
        matrices = self.model.matrices(parameters.poses, parameters.shared)
        homographies = self.of_links(matrices)
        equations = link_equations(self.observations, homographies, parameters.lens, width, self.free.lens)
        return _State(parameters, matrices, homographies, equations)

    def _cost(self, parameters: Parameters, errors: FloatArray, sigma: float, width: float) -> float:
        """Cost of errors (M, 2) at some parameters, with the priors."""
        lost = float(robust_cost(squared_lengths(errors), width).sum())
        return lost * self.weight(sigma) + self._prior_cost(parameters)

    def _homographies(self, parameters: Parameters) -> FloatArray:
        return self.of_links(self.model.matrices(parameters.poses, parameters.shared))

    def of_links(self, matrices: ModelMatrices) -> FloatArray:
        """``H_ij = P_j P_i⁻¹`` of each link, shape (L, 3, 3)."""
        i, j = self.observations.image1, self.observations.image2
        with np.errstate(all="ignore"):
            product: FloatArray = matrices.matrices[j] @ inverses(matrices.matrices)[i]
        return product

    def _wide_width(self, squared: FloatArray) -> float:
        """Width of the loss, pixels, at which most links still count, as far off as a chain may have put them."""
        medians = self.observations.medians(np.sqrt(squared))
        of_most_links = 1.5 * float(np.quantile(np.where(np.isfinite(medians), medians, 1e9), 0.95))
        return min(of_most_links, WIDEST_START * float(np.median(self.observations.scale2)))

    def weight(self, sigma: float) -> float:
        """Weight of squared errors of this scatter: one over their variance, as far as they are independent."""
        return 1.0 / (sigma**2 * self.overdispersion)

    def camera_prior_cost(self, parameters: Parameters) -> float:
        """-2 log of the prior density of the camera, relative to the largest.

        With a focal length that grows without limit a turn becomes a shift over a plane, and ground a tilt.
        """
        physical = self.model.physical_parameters(parameters.shared)[0]
        return float(prior_costs(self.priors.camera, np.concatenate([physical, parameters.lens])).sum())

    def _prior_cost(self, parameters: Parameters) -> float:
        offsets = self.model.prior_coordinates(parameters.poses) - self.priors.poses
        known = self.camera_prior_cost(parameters) + float((self.priors.poses_precision * offsets**2).sum())
        if (marks := self.priors.marks) is None:
            return known
        matrices = self.model.matrices(parameters.poses, parameters.shared).matrices
        return known + marks.cost(matrices, parameters.lens, self.model.focal(parameters.shared))

    def _normal_equations(self, state: _State, sigma: float) -> SparseNormalEquations:
        """Normal equations of the data at ``state``, and of the priors."""
        normal = assemble(
            state.equations,
            self.observations,
            state.matrices,
            state.homographies,
            self.free.poses,
            self.weight(sigma),
            self._of_marks(state),
        )
        p = self.priors
        physical, derivative = self.named_parameters(state.parameters.shared)
        estimated = np.concatenate([np.ones(len(physical), dtype=np.bool_), self.free.lens])
        of_camera = prior_slopes(p.camera, np.concatenate([physical, state.parameters.lens]))
        slope, precision = (one[estimated] for one in of_camera)
        poses = self.model.prior_coordinates(state.parameters.poses) - p.poses
        return normal.with_priors(
            p.poses_precision, poses, derivative.T @ (precision[:, None] * derivative), derivative.T @ slope
        )

    def _of_marks(self, state: _State) -> ImageEquations | None:
        if (marks := self.priors.marks) is None:
            return None
        focal = self.model.focal(state.parameters.shared)
        errors, derivative = marks.equations(state.matrices, state.parameters.lens, self.free.lens, focal)
        return ImageEquations(marks.image, derivative, errors, marks.precision)

    def named_parameters(self, shared: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The named parameters (S,), and their derivatives by the shared ones and by the lens (S', S')."""
        physical, derivative = self.model.physical_parameters(shared)
        size, lens = len(physical), int(self.free.lens.sum())
        with_lens = np.eye(size + lens)
        with_lens[:size, :size] = derivative
        return physical, with_lens


def inverse_information(information: FloatArray) -> FloatArray:
    """Inverse of an information matrix; large, not infinite, for what is not determined."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-12))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    inverse: FloatArray = (vectors / np.maximum(values, 1e-14)) @ vectors.T * np.outer(scale, scale)
    return inverse
