"""Refinement of homography and λ over all matches of many pairs at once."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.division_model import MAX_ABS_DISTORTION
from rdstitch.robust.levenberg_marquardt import BatchedNormalEquations, descend
from rdstitch.robust.linearization import PairLenses, TransferDerivatives, differentiate, entry_equations, influence
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.pair_models import PairModel


@dataclass(frozen=True)
class Fits:
    """One model fitted to the matches of B pairs."""

    state: FloatArray  # (B, S): the model's states
    homography: FloatArray  # (B, 3, 3)
    distortion: FloatArray  # (B,): λ in the half-diagonal frame

    def take(self, rows: BoolArray | IntArray | slice) -> "Fits":
        """Those of some pairs."""
        return Fits(self.state[rows], self.homography[rows], self.distortion[rows])


@dataclass(frozen=True)
class PairProblems:
    """Refinement of B pairs as problems of least squares; parameters are ``(λ, state)``."""

    model: PairModel
    data: Measurements
    scale: FloatArray  # (B,): of the loss, pixels
    noise: FloatArray  # (B,): standard deviation of the errors per axis, pixels
    fixed_distortion: bool  # whether λ is known

    def take(self, rows: BoolArray | IntArray) -> Self:
        """Some of them."""
        return replace(self, data=self.data.take(rows), scale=self.scale[rows], noise=self.noise[rows])

    def normal_equations(self, parameters: FloatArray) -> BatchedNormalEquations:
        """Loss, normal matrix and gradient."""
        distortion, state = parameters[:, 0], parameters[:, 1:]
        found = differentiate(self.model.homography(state), PairLenses(distortion), self.data)
        return self._equations(found, state, self.chain(state))

    def _equations(self, found: TransferDerivatives, state: FloatArray, chain: FloatArray) -> BatchedNormalEquations:
        entries = entry_equations(found, self.data.present, self.scale, not self.fixed_distortion)
        information = np.swapaxes(chain, 1, 2) @ entries.information @ chain
        gradient = np.einsum("bkp,bk->bp", chain, entries.gradient)
        cost = entries.cost
        residual, by_state = self.model.prior(state)
        if residual.shape[1]:
            free = 0 if self.fixed_distortion else 1
            weight = self.noise**2
            information[:, free:, free:] += weight[:, None, None] * (by_state.T @ by_state)
            gradient[:, free:] += weight[:, None] * (residual @ by_state)
            cost = cost + weight * (residual**2).sum(axis=1)
        return BatchedNormalEquations(cost, information, gradient, entries.squared)

    def chain(self, state: FloatArray) -> FloatArray:
        """Derivative of the entries of H and λ by λ and the model's parameters, (B, 9 + E, E + P)."""
        free = 0 if self.fixed_distortion else 1
        by_state = self.model.jacobian(state)
        chain = np.zeros((len(state), 9 + free, free + by_state.shape[2]))
        chain[:, :9, free:] = by_state
        chain[:, 9:, :free] = 1.0
        return chain

    def retract(self, parameters: FloatArray, step: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Parameters after steps, and whether a lens can be so."""
        free = 0 if self.fixed_distortion else 1
        moved = np.empty_like(parameters)
        moved[:, 0] = parameters[:, 0] + (step[:, 0] if free else 0.0)
        moved[:, 1:] = self.model.retract(parameters[:, 1:], step[:, free:])
        within = (np.abs(moved[:, 0]) < MAX_ABS_DISTORTION) | self.fixed_distortion
        possible = within & np.isfinite(moved).all(axis=1)
        return np.where(possible[:, None], moved, parameters), possible

    def inspect(self, fits: Fits) -> tuple[BatchedNormalEquations, FloatArray]:
        """The equations at fits, and each match's share of the gradient there, (B, N, P)."""
        found = differentiate(fits.homography, PairLenses(fits.distortion), self.data)
        chain = self.chain(fits.state)
        shares = influence(found, self.data.present, self.scale, not self.fixed_distortion) @ chain
        return self._equations(found, fits.state, chain), shares


@np.errstate(all="ignore")  # a step may leave the domain of the lens model
def refine_pairs(
    problems: PairProblems,
    start: Fits,
    iterations: int,
    *,
    rough: bool = False,
) -> tuple[Fits, BatchedNormalEquations]:
    """Fit the model and λ by at most so many steps; the fits, and the equations there.

    Parameters
    ----------
    problems : PairProblems
        Of B pairs.
    start : Fits
        Their ``distortion`` is kept where it is fixed.
    iterations : int
    rough : bool
        Another refinement goes on from there.
    """
    parameters = np.column_stack([start.distortion, start.state])
    found, equations = descend(problems, problems.retract, parameters, iterations, rough=rough)
    state = found[:, 1:]
    return Fits(state, problems.model.homography(state), found[:, 0]), equations
