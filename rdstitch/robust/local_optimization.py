"""Refinement of homography and λ over all correspondences at once.

Levenberg-Marquardt on the parameters of a pair model and λ, with the Geman-McClure loss
``e² / (1 + e²/c²)`` of the whitened transfer error in measured pixels, so that correspondences that do not fit lose
their influence without ever being decided upon.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.division_model import MAX_ABS_DISTORTION
from rdstitch.radial_homography import (
    TransferJacobian,
    measurement_whitening,
    points_last,
    side_by_side,
    transfer_jacobian,
    whiten,
)
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.pair_models import PairModel

_LEAST_GAIN = 1e-5  # expected relative fall of the loss that is worth another step: a hundredth of the noise

State = TypeVar("State")
_State = tuple[FloatArray, float]  # of the model, and λ


@dataclass(frozen=True)
class Refined:
    """A model fitted to the correspondences.

    Attributes
    ----------
    model : PairModel
    state : ndarray
        The model's state.
    distortion : float
        λ in the half-diagonal frame.
    errors : ndarray of shape (N,)
        Whitened transfer errors, px; inf where the point cannot be transferred.
    cost : float
        Value of the loss, px².
    information : ndarray of shape (P, P)
        Weighted ``J'J``: by λ first (only where it was free), then by the model's parameters.
    influence : ndarray of shape (N, P)
        Each correspondence's share of the gradient, in the same order.
    """

    model: PairModel
    state: FloatArray
    distortion: float
    errors: FloatArray
    cost: float
    information: FloatArray
    influence: FloatArray

    @property
    def homography(self) -> FloatArray:
        """H (3, 3)."""
        return self.model.homography(self.state)


@dataclass(frozen=True)
class Linearized:
    """The loss at some parameters, and what a step from there takes.

    Attributes
    ----------
    cost : float
    errors : ndarray of shape (N,)
    information : ndarray of shape (P, P)
    gradient : ndarray of shape (P,)
    influence : ndarray of shape (N, P)
        As in :class:`Refined`.
    """

    cost: float
    errors: FloatArray
    information: FloatArray
    gradient: FloatArray
    influence: FloatArray


def refine(
    model: PairModel,
    homography: FloatArray,
    distortion: float,
    data: Measurements,
    scale: float,
    *,
    fixed_distortion: bool = False,
    noise: float = 1.0,
    iterations: int = 10,
) -> Refined:
    """Fit a model and λ, starting from a homography.

    Parameters
    ----------
    model : PairModel
    homography : ndarray of shape (3, 3)
    distortion : float
        Start of λ, or its value if ``fixed_distortion``.
    data : Measurements
    scale : float
        ``c`` of the loss, px.
    noise : float
        Standard deviation of the measurements, px: the weight of the model's prior against the data.
    iterations : int
        At most so many steps.
    """
    first = 0 if fixed_distortion else 1

    def evaluate(state: _State) -> Linearized:
        return _linearize(model, *state, data, scale, fixed_distortion, noise)

    def move(state: _State, step: FloatArray) -> _State | None:
        moved = model.retract(state[0], step[first:]), state[1] if fixed_distortion else float(state[1] + step[0])
        return moved if abs(moved[1]) < MAX_ABS_DISTORTION and np.isfinite(moved[0]).all() else None

    (state, distortion), found = descend(evaluate, move, (model.initialize(homography), distortion), iterations)
    return Refined(model, state, distortion, found.errors, found.cost, found.information, found.influence)


def descend(
    evaluate: Callable[[State], Linearized],
    move: Callable[[State, FloatArray], State | None],
    start: State,
    iterations: int,
) -> tuple[State, Linearized]:
    """Levenberg-Marquardt: where at most so many steps lead to, and the loss there.

    Parameters
    ----------
    evaluate : callable
        The loss at a state.
    move : callable
        The state after a step of shape (P,), or None where there is no such state.
    """
    state, current = start, evaluate(start)
    damping = 1e-4
    for _ in range(iterations):
        diagonal = np.diag(current.information)
        damped = current.information + np.diag(damping * diagonal + 1e-12 * diagonal.max(initial=1e-300))
        try:
            step = np.asarray(-np.linalg.solve(damped, current.gradient), dtype=np.float64)
        except np.linalg.LinAlgError:
            break
        if -(step @ current.gradient) <= _LEAST_GAIN * current.cost:
            break
        moved = move(state, step)
        if moved is not None:
            there = evaluate(moved)
            if there.cost < current.cost:
                state, current = moved, there
                damping = max(damping / 10.0, 1e-9)
                continue
        damping *= 20.0
        if damping > 1e4:
            break
    return state, current


def _linearize(
    model: PairModel,
    state: FloatArray,
    distortion: float,
    data: Measurements,
    scale: float,
    fixed_distortion: bool,
    noise: float,
) -> Linearized:
    """Loss, normal matrix and gradient at a state."""
    transfer = transfer_jacobian(model.homography(state), distortion, data.x1)
    lens = np.empty((len(data.x1), 2, 0)) if fixed_distortion else transfer.by_distortion
    by_state = model.jacobian(state)
    chain = np.zeros((lens.shape[2] + 9, lens.shape[2] + by_state.shape[1]))
    chain[: lens.shape[2], : lens.shape[2]] = np.eye(lens.shape[2])
    chain[lens.shape[2] :, lens.shape[2] :] = by_state
    prior, by_prior = model.prior(state)
    if len(prior):
        by_prior = np.hstack([np.zeros((len(prior), lens.shape[2])), by_prior])
    return linearized(
        transfer, side_by_side(lens, transfer.by_homography), chain, (prior, by_prior), data, scale, noise
    )


def linearized(
    transfer: TransferJacobian,
    columns: FloatArray,
    chain: FloatArray,
    prior: tuple[FloatArray, FloatArray],
    data: Measurements,
    scale: float,
    noise: float,
) -> Linearized:
    """The loss of transferred points and what is known beforehand.

    Parameters
    ----------
    transfer : TransferJacobian
    columns : ndarray of shape (N, 2, K)
        Derivatives of the transferred points by what the parameters change.
    chain : ndarray of shape (K, P)
        Derivatives of that by the parameters.
    prior : pair of ndarray of shape (R,) and (R, P)
        Residuals in standard deviations, and their derivatives by the parameters.
    data : Measurements
    scale : float
        ``c`` of the loss, px.
    noise : float
        Standard deviation of the measurements, px.
    """
    residuals = (transfer.points - data.x2) * data.px
    lost = ~np.isfinite(residuals).all(axis=1)
    whitening = measurement_whitening(transfer.by_point * data.px_ratio)
    residuals = whiten(whitening, residuals[:, :, None])[:, :, 0]
    residuals[lost] = 0.0
    errors2 = np.einsum("ni,ni->n", residuals, residuals)
    relative = 1.0 / (1.0 + errors2 / scale**2)
    relative[lost] = 0.0

    # The normal matrix is formed by the entries of H, whatever the model, and only then by the model's parameters.
    columns = whiten(whitening * (data.px * relative)[:, None, None], columns)
    columns[lost] = 0.0
    across, down = points_last(columns)
    information = chain.T @ (across @ across.T + down @ down.T) @ chain
    weighted = residuals * relative[:, None]
    influence = (across * weighted[:, 0] + down * weighted[:, 1]).T @ chain
    gradient = influence.sum(axis=0)
    cost = float(errors2 @ relative) + scale**2 * int(lost.sum())
    residual, by_parameters = prior
    if len(residual):
        information = information + noise**2 * by_parameters.T @ by_parameters
        gradient = gradient + noise**2 * by_parameters.T @ residual
        cost += noise**2 * float(residual @ residual)
    errors = np.sqrt(errors2)
    errors[lost] = np.inf
    return Linearized(cost, errors, information, gradient, influence)
