"""Refinement of homography and λ over all correspondences at once.

Levenberg-Marquardt on the parameters of a pair model and λ, with the Geman-McClure loss
``e² / (1 + e²/c²)`` of the whitened transfer error in measured pixels, so that correspondences that do not fit lose
their influence without ever being decided upon.
"""

from dataclasses import dataclass

import numpy as np

from rdstitch.camera import FloatArray
from rdstitch.radial_homography import measurement_whitening, transfer_jacobian, whiten
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.pair_models import PairModel

_LEAST_GAIN = 1e-5  # expected relative fall of the loss that is worth another step: a hundredth of the noise
_LARGEST_BEND = 0.98  # |λ| in the half-diagonal frame; beyond, the lens model folds at the corner


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
class _Linearized:
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
    state = model.initialize(homography)
    current = _linearize(model, state, distortion, data, scale, fixed_distortion, noise)
    damping = 1e-4
    first = 0 if fixed_distortion else 1
    for _ in range(iterations):
        diagonal = np.diag(current.information)
        damped = current.information + np.diag(damping * diagonal + 1e-12 * diagonal.max(initial=1e-300))
        try:
            step = np.asarray(-np.linalg.solve(damped, current.gradient), dtype=np.float64)
        except np.linalg.LinAlgError:
            break
        if -(step @ current.gradient) <= _LEAST_GAIN * current.cost:
            break
        moved_distortion = distortion if fixed_distortion else float(distortion + step[0])
        moved_state = model.retract(state, step[first:])
        if abs(moved_distortion) < _LARGEST_BEND and np.isfinite(moved_state).all():
            moved = _linearize(model, moved_state, moved_distortion, data, scale, fixed_distortion, noise)
            if moved.cost < current.cost:
                state, distortion, current = moved_state, moved_distortion, moved
                damping = max(damping / 10.0, 1e-9)
                continue
        damping *= 20.0
        if damping > 1e4:
            break
    return Refined(model, state, distortion, current.errors, current.cost, current.information, current.influence)


def _linearize(
    model: PairModel,
    state: FloatArray,
    distortion: float,
    data: Measurements,
    scale: float,
    fixed_distortion: bool,
    noise: float,
) -> _Linearized:
    """Loss, normal matrix and gradient at a state."""
    transfer = transfer_jacobian(model.homography(state), distortion, data.x1)
    residuals = (transfer.points - data.x2) * data.px
    lost = ~np.isfinite(residuals).all(axis=1)
    lens = transfer.by_lens[:, :, :0] if fixed_distortion else transfer.by_lens[:, :, :1]
    whitening = measurement_whitening(transfer.by_point * data.px_ratio)
    residuals = whiten(whitening, residuals[:, :, None])[:, :, 0]
    residuals[lost] = 0.0
    errors2 = np.einsum("ni,ni->n", residuals, residuals)
    relative = 1.0 / (1.0 + errors2 / scale**2)
    relative[lost] = 0.0

    # The normal matrix is formed by the entries of H, whatever the model, and only then by the model's parameters.
    columns = np.concatenate([lens, transfer.by_homography], axis=2)
    columns = whiten(whitening * (data.px * relative)[:, None, None], columns)
    columns[lost] = 0.0
    flat = columns.reshape(-1, columns.shape[2])
    by_state = model.jacobian(state)
    chain = np.zeros((columns.shape[2], lens.shape[2] + by_state.shape[1]))
    chain[: lens.shape[2], : lens.shape[2]] = np.eye(lens.shape[2])
    chain[lens.shape[2] :, lens.shape[2] :] = by_state
    information = chain.T @ (flat.T @ flat) @ chain
    influence = np.einsum("nip,ni->np", columns, residuals * relative[:, None]) @ chain
    gradient = influence.sum(axis=0)
    cost = float(errors2 @ relative) + scale**2 * int(lost.sum())

    prior, by_prior = model.prior(state)
    if len(prior):
        by_prior = np.hstack([np.zeros((len(prior), lens.shape[2])), by_prior])
        information = information + noise**2 * by_prior.T @ by_prior
        gradient = gradient + noise**2 * by_prior.T @ prior
        cost += noise**2 * float(prior @ prior)
    errors = np.sqrt(errors2)
    errors[lost] = np.inf
    return _Linearized(cost, errors, information, gradient, influence)
