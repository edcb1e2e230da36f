"""Refinement of homography and λ over all matches of many pairs at once."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.division_model import MAX_ABS_DISTORTION
from rdstitch.numerics.robust_loss import loss_width, noise_of, robust_cost
from rdstitch.robust.covariance import covariances
from rdstitch.robust.levenberg_marquardt import BatchedNormalEquations, descend
from rdstitch.robust.linearization import PairLenses, TransferDerivatives, differentiate, entry_equations, influence
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.pair_models import PairModel
from rdstitch.robust.priors import Prior, prior_costs, prior_slopes

_STATE = 9  # numbers of a state of any pair model; before these, parameters have those of the lens


@dataclass(eq=False)
class PairEquations(BatchedNormalEquations):
    """The equations of B pairs, and what they were made from."""

    scale: FloatArray  # (B,): of the loss, pixels
    noise: FloatArray  # (B,): standard deviation of the errors per axis, pixels
    prior: FloatArray  # (B,): cost of the priors, in units of the noise
    transferred: TransferDerivatives

    @property
    def unit(self) -> FloatArray:
        """The variance of the errors."""
        return self.noise**2


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
        entries = entry_equations(transferred, self.data.present, scale, self.free > 0)
        information = np.swapaxes(jacobian, 1, 2) @ entries.information @ jacobian
        gradient = (entries.gradient[:, None] @ jacobian)[:, 0]
        weight = noise**2
        prior, slope, curvature = self.model.prior(parameters[:, -_STATE:])
        # The prior on a λ that all pairs share counts once, where their votes come together.
        by_lens = np.zeros((2, len(parameters), self.free))
        if self.lens is not None:
            prior = prior + prior_costs(self.lens, parameters[:, :-_STATE]).sum(axis=1)
            by_lens = np.stack(prior_slopes(self.lens, parameters[:, :-_STATE]))
        gradient += weight[:, None] * np.hstack([by_lens[0], slope])
        np.einsum("bpp->bp", information)[...] += weight[:, None] * np.hstack([by_lens[1], curvature])
        cost = entries.cost + weight * prior
        return PairEquations(cost, information, gradient, entries.squared, scale, noise, prior, transferred)

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
def refine_pairs(
    problems: PairProblems,
    homography: FloatArray,
    distortion: FloatArray,
    tilts: FloatArray | None,
    iterations: int,
    *,
    loose: bool = False,
) -> tuple[FloatArray, PairEquations]:
    """Parameters (B, 10) that at most so many steps lead to, and the equations there.

    From homographies (B, 3, 3), λ (B,), which is kept where it is fixed, and known tilts (B, 2, 2); ``loose``: another
    refinement goes on from there.
    """
    state = problems.model.initialize(homography, tilts)
    return descend(problems, np.column_stack([distortion, state]), iterations, loose=loose)
