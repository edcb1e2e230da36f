"""Refinement of homography and λ over all matches of many pairs at once."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray, Rows
from rdstitch.geometry.division_model import MAX_ABS_DISTORTION
from rdstitch.numerics.robust_loss import loss_width, noise_of, robust_cost
from rdstitch.robust.covariance import covariances
from rdstitch.robust.levenberg_marquardt import MAX_DAMPING, MIN_DAMPING, damped_step
from rdstitch.robust.linearization import PairLenses, TransferDerivatives, differentiate, entry_equations, influence
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.pair_models import PairModel
from rdstitch.robust.priors import Prior, prior_costs, prior_slopes

_SHORT_STEP = 0.3  # standard deviations of all parameters together: a step that is not worth taking
_LOOSE_STEP = 1.0  # the same where another descent goes on from there
_FIRST_DAMPING = 1e-4  # fraction of the diagonal of the normal matrix
_STATE = 9  # numbers of a state of any pair model; before these, parameters have those of the lens


@dataclass(eq=False)
class PairEquations(Rows):
    """The loss of B pairs at some parameters, and what a step from there takes."""

    cost: FloatArray  # (B,)
    information: FloatArray  # (B, P, P): weighted ``J'J``
    gradient: FloatArray  # (B, P): half the gradient of the cost
    squared: FloatArray  # (B, N): squared errors of the matches; inf where there is none
    scale: FloatArray  # (B,): of the loss, pixels
    noise: FloatArray  # (B,): standard deviation of the errors per axis, pixels
    prior: FloatArray  # (B,): cost of the priors, in units of the noise
    transferred: TransferDerivatives

    @property
    def errors(self) -> FloatArray:
        """Errors of the matches, (B, N); inf where there is none."""
        return np.sqrt(self.squared)


@dataclass(frozen=True, eq=False)
class PairProblems:
    """Refinement of B pairs as problems of least squares.

    Parameters are ``(λ, state)``; with priors on a ``lens``, ``(λ of image 1, λ of image 2, μ, centre, state)``. Where
    no noise is given, it follows from the errors, and the width of the loss from it: the loss becomes narrow as the fit
    becomes good.
    """

    model: PairModel
    data: Measurements
    scale: FloatArray  # (B,): of the loss, pixels; without ``noise`` the largest
    noise: FloatArray | None = None  # (B,): standard deviation of the errors per axis, pixels
    fixed_distortion: bool = False  # whether λ is known
    lens: tuple[Prior, ...] | None = None  # on the parameters of the lens

    @property
    def free(self) -> int:
        """Number of parameters of the lens that are estimated."""
        return 0 if self.fixed_distortion else 1 if self.lens is None else len(self.lens)

    def start(self, homography: FloatArray, distortion: FloatArray, tilts: FloatArray | None = None) -> FloatArray:
        """Parameters (B, 10) nearest to homographies (B, 3, 3) with λ (B,), and with known tilts (B, 2, 2)."""
        return np.column_stack([distortion, self.model.initialize(homography, tilts)])

    def take(self, rows: BoolArray | IntArray) -> Self:
        """Some of them."""
        noise = None if self.noise is None else self.noise[rows]
        return replace(self, data=self.data.take(rows), scale=self.scale[rows], noise=noise)

    def transfer(self, parameters: FloatArray) -> TransferDerivatives:
        """The matches transferred, with derivatives by the entries of H and the lens."""
        lens = parameters[:, :-_STATE].T
        lenses = PairLenses(lens[0]) if self.lens is None else PairLenses(lens[0], lens[1], lens[2], lens[3:].T)
        return differentiate(self.homography(parameters), lenses, self.data)

    def homography(self, parameters: FloatArray) -> FloatArray:
        """H (B, 3, 3)."""
        return self.model.homography(parameters[:, -_STATE:])

    def normal_equations(self, parameters: FloatArray) -> PairEquations:
        """Loss, normal matrix and gradient."""
        transferred, jacobian = self.transfer(parameters), self.jacobian(parameters)
        scale, noise = self.scale, self.noise
        squared = np.where(transferred.lost | ~self.data.present, np.inf, transferred.squared)
        if noise is None:
            noise = noise_of(np.sqrt(squared), scale, jacobian.shape[2])
            scale = loss_width(noise, scale)
        cost, information, gradient = entry_equations(transferred, self.data.present, scale, self.free > 0)
        information = np.swapaxes(jacobian, 1, 2) @ information @ jacobian
        gradient = (gradient[:, None] @ jacobian)[:, 0]
        weight = noise**2
        prior, slope, curvature = self.model.prior(parameters[:, -_STATE:])
        # The prior on a λ that all pairs share counts once, where their votes come together.
        by_lens = np.zeros((2, len(parameters), self.free))
        if self.lens is not None:
            prior = prior + prior_costs(self.lens, parameters[:, :-_STATE]).sum(axis=1)
            by_lens = np.stack(prior_slopes(self.lens, parameters[:, :-_STATE]))
        gradient += weight[:, None] * np.hstack([by_lens[0], slope])
        np.einsum("bpp->bp", information)[...] += weight[:, None] * np.hstack([by_lens[1], curvature])
        cost = cost + weight * prior
        return PairEquations(cost, information, gradient, squared, scale, noise, prior, transferred)

    def cost(self, before: PairEquations, after: PairEquations) -> FloatArray:
        """Loss of ``before`` with the width and the noise of ``after``."""
        if self.noise is not None:
            return before.cost
        prior = (after.noise**2 - before.noise**2) * before.prior
        change, unchanged = (robust_cost(before.squared, each.scale[:, None]) for each in (after, before))
        return np.asarray(before.cost + prior + ((change - unchanged) * self.data.present).sum(axis=1))

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """Derivative of the entries of H and the lens by the lens and the model's parameters, (B, 9 + E, E + P)."""
        by_state = self.model.jacobian(parameters[:, -_STATE:])
        jacobian = np.zeros((len(parameters), 9 + self.free, self.free + by_state.shape[2]))
        jacobian[:, :9, self.free :] = by_state
        jacobian[:, 9:, : self.free] = np.eye(self.free)
        return jacobian

    def retract(self, parameters: FloatArray, step: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Parameters after steps, and whether a lens can be so."""
        lens = parameters[:, :-_STATE] + (step[:, : self.free] if self.free else 0.0)
        moved = np.hstack([lens, self.model.retract(parameters[:, -_STATE:], step[:, self.free :])])
        within = (np.abs(lens[:, :2]).max(axis=1) < MAX_ABS_DISTORTION) | self.fixed_distortion
        possible = within & np.isfinite(moved).all(axis=1)
        return np.where(possible[:, None], moved, parameters), possible

    def covariances(self, parameters: FloatArray, equations: PairEquations) -> FloatArray:
        """Covariances (B, P, P) of the parameters at their present values."""
        of_matches = influence(equations.transferred, self.data.present, equations.scale, self.free > 0)
        jacobian = self.jacobian(parameters)
        return covariances(equations.information, of_matches, jacobian, equations.noise, self.data)


@np.errstate(all="ignore")  # a step may leave the domain of the lens model
def descend(
    problems: PairProblems, start: FloatArray, iterations: int, *, loose: bool = False
) -> tuple[FloatArray, PairEquations]:
    """Where at most so many steps lead to, parameters of shape (B, K), and the equations there.

    Damping falls tenfold or rises twentyfold, which suffices for a pair. A problem that has converged takes no further
    part, so that each is solved as if it were alone. ``loose``: another descent goes on from there.
    """
    least_gain = (_LOOSE_STEP if loose else _SHORT_STEP) ** 2
    result, parameters = start.copy(), start
    current = equations = problems.normal_equations(start)
    damping, rows = np.full(len(start), _FIRST_DAMPING), np.arange(len(start))
    for _ in range(iterations):
        step = damped_step(current.information, current.gradient, damping)
        gain = -np.einsum("bp,bp->b", step, current.gradient)
        going = (gain > least_gain * current.noise**2) & (damping <= MAX_DAMPING)
        if not going.any():
            break
        if not going.all():
            result[rows[~going]] = parameters[~going]
            equations.put(rows[~going], current.take(~going))
            rows, step, parameters, damping = rows[going], step[going], parameters[going], damping[going]
            problems, current = problems.take(going), current.take(going)
        moved, possible = problems.retract(parameters, step)
        trial = problems.normal_equations(moved)
        better = possible & (trial.cost < problems.cost(current, trial))
        damping = np.where(better, np.maximum(damping / 10.0, MIN_DAMPING), damping * 20.0)  # Marquardt (1963)
        if better.all():
            parameters, current = moved, trial
        elif better.any():
            parameters, current = np.where(better[:, None], moved, parameters), current.take(np.arange(len(rows)))
            current.put(better, trial.take(better))
    if len(rows) == len(start):
        return parameters, current
    result[rows] = parameters
    equations.put(rows, current)
    return result, equations
