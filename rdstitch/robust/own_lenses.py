"""Homography and, for each of the two pictures, a λ of its own: what a pair sees of two lenses.

A lens that is no division model, or whose axis misses the centre of the picture, bends one part of a picture more than
another, and the two pictures of a pair overlap in different parts of them. So that this is not taken for two lenses, μ
and the distortion centre, which both pictures share, are free too.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.camera import LENS_STD
from rdstitch.division_model import MAX_ABS_DISTORTION
from rdstitch.radial_homography import RadialHomography, side_by_side, transfer_jacobian
from rdstitch.robust.local_optimization import Linearized, descend, linearized
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.model_selection import covariance_of, loss_width, noise_of
from rdstitch.robust.pair_models import HomographyModel

_HOMOGRAPHY = HomographyModel()
_OWN_STD = LENS_STD[[0, 0, 1, 3, 4]]  # of λ of picture 1, λ of picture 2, μ, and the distortion centre
_LENS = len(_OWN_STD)
_ITERATIONS = 10
_ROUNDS = 2  # what one λ leaves is no measure of the noise

_State = tuple[FloatArray, FloatArray]  # of the homography, and of the lenses as in _OWN_STD


@dataclass(frozen=True)
class OwnLenses:
    """λ of both pictures of a pair, half-diagonal frame.

    Attributes
    ----------
    distortion : ndarray of shape (2,)
    covariance : ndarray of shape (2, 2)
    """

    distortion: FloatArray
    covariance: FloatArray


def own_lenses(relation: RadialHomography, data: Measurements, threshold: float) -> OwnLenses:
    """Free λ of each picture of a pair, from the relation that one λ gave.

    Parameters
    ----------
    relation : RadialHomography
    data : Measurements
        Also of what one λ could not explain.
    threshold : float
        Largest transfer error of an inlier, px.
    """
    state: _State = _HOMOGRAPHY.initialize(relation.homography), np.zeros(_LENS)
    state[1][:2] = relation.distortion
    found = _linearize(state, data, threshold, noise=1.0)
    for _ in range(_ROUNDS):
        noise = noise_of(found.errors, threshold)
        evaluate = partial(_linearize, data=data, scale=loss_width(noise, threshold), noise=noise)
        state, found = descend(evaluate, _moved, state, _ITERATIONS)
    return OwnLenses(state[1][:2], covariance_of(found, noise_of(found.errors, threshold), data)[:2, :2])


def _moved(state: _State, step: FloatArray) -> _State | None:
    """The state after a step; None where a lens would fold."""
    lens = state[1] + step[:_LENS]
    return (_HOMOGRAPHY.retract(state[0], step[_LENS:]), lens) if np.abs(lens[:2]).max() < MAX_ABS_DISTORTION else None


@np.errstate(all="ignore")  # a wild step may leave the lens model
def _linearize(state: _State, data: Measurements, scale: float, noise: float) -> Linearized:
    """Loss, normal matrix and gradient at a state."""
    homography, lens = state
    (first, second, mu), center = lens[:3].tolist(), lens[3:]
    transfer = transfer_jacobian(
        _HOMOGRAPHY.homography(homography), first, data.x1 - center, (mu,), own_distortion=second
    )
    own, shared = transfer.by_own_distortion, transfer.by_lens[:, :, [1, 3, 4]]
    columns = side_by_side(transfer.by_distortion - own, own, shared, transfer.by_homography)
    chain = np.zeros((_LENS + 9, _LENS + 8))
    chain[:_LENS, :_LENS] = np.eye(_LENS)
    chain[_LENS:, _LENS:] = _HOMOGRAPHY.jacobian(homography)
    prior = lens / _OWN_STD, np.hstack([np.diag(1.0 / _OWN_STD), np.zeros((_LENS, 8))])
    return linearized(replace(transfer, points=transfer.points + center), columns, chain, prior, data, scale, noise)
