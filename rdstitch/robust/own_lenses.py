"""Homography and, for each of the two images, a λ of its own: what a pair sees of two lenses.

A lens that is no division model, or whose axis misses the centre of the image, bends one part of an image more than
another, and the two images of a pair overlap in different parts of them. So that this is not taken for two lenses, μ
and the distortion centre, which both images share, are free too.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.camera import LENS_STD
from rdstitch.division_model import MAX_ABS_DISTORTION
from rdstitch.late_imports import spatial
from rdstitch.radial_homography import RadialHomography
from rdstitch.robust.covariance import covariances
from rdstitch.robust.levenberg_marquardt import BatchedNormalEquations, descend
from rdstitch.robust.linearization import PairLenses, differentiate, entry_equations, influence
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.model_selection import loss_width, noise_of
from rdstitch.robust.pair_models import HomographyPairModel

_HOMOGRAPHY = HomographyPairModel()
_OWN_STD = LENS_STD[[0, 0, 1, 3, 4]]  # of λ of image 1, λ of image 2, μ, and the distortion centre
_LENS = len(_OWN_STD)
_ITERATIONS = 10
_ROUNDS = 2  # what one λ leaves is no measure of the noise


@dataclass(frozen=True)
class OwnLenses:
    """λ of both images of a pair, half-diagonal frame."""

    distortion: FloatArray  # (2,)
    covariance: FloatArray  # (2, 2)
    # correlation of the errors of neighbours that are left: 0 for noise, up to 1 where depth moves them together
    coherence: float


def own_lenses(relations: Sequence[RadialHomography], data: Measurements, threshold: float) -> list[OwnLenses]:
    """Free λ of each image of pairs, from the relations that one λ gave.

    Parameters
    ----------
    relations : sequence of RadialHomography
        One a pair.
    data : Measurements
        Also of what one λ could not explain.
    threshold : float
        Largest transfer error of an inlier, pixels.
    """
    count = len(data)
    parameters = np.zeros((count, _LENS + 9))
    parameters[:, :2] = [[relation.distortion] * 2 for relation in relations]
    parameters[:, _LENS:] = _HOMOGRAPHY.initialize(np.stack([relation.homography for relation in relations]))
    with np.errstate(all="ignore"):  # a step may leave the domain of the lens model
        problems = _Problems(data, np.full(count, threshold), np.ones(count))
        found = problems.normal_equations(parameters)
        for _ in range(_ROUNDS):
            noise = noise_of(found.errors, threshold)
            problems = _Problems(data, loss_width(noise, threshold), noise)
            parameters, found = descend(problems, _retract, parameters, _ITERATIONS)
        noise = noise_of(found.errors, threshold)
        covariance = covariances(found.information, problems.influence(parameters), noise, data)
        left = differentiate(*_parts(parameters), data)
        inliers = data.present & ~left.lost & (left.squared < loss_width(noise, threshold)[:, None] ** 2)
    coherence = [
        _coherence(points[:, own].T, errors[:, own].T)
        for points, errors, own in zip(data.x1, left.error, inliers, strict=True)
    ]
    return [
        OwnLenses(own[:2], known[:2, :2], shared)
        for own, known, shared in zip(parameters, covariance, coherence, strict=True)
    ]


def _coherence(points: FloatArray, errors: FloatArray) -> float:
    """Correlation of the errors (N, 2) of points (N, 2) and their nearest neighbours."""
    if len(points) < 2:
        return 0.0
    nearest = np.asarray(spatial.cKDTree(points).query(points, k=2)[1])[:, 1]
    power = float(np.einsum("ni,ni->", errors, errors))
    return float(np.einsum("ni,ni->", errors, errors[nearest])) / power if power > 0.0 else 0.0


def _retract(parameters: FloatArray, step: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Parameters after steps, and whether no lens would fold."""
    lens = parameters[:, :_LENS] + step[:, :_LENS]
    moved = np.hstack([lens, _HOMOGRAPHY.retract(parameters[:, _LENS:], step[:, _LENS:])])
    possible = (np.abs(lens[:, :2]).max(axis=1) < MAX_ABS_DISTORTION) & np.isfinite(moved).all(axis=1)
    return np.where(possible[:, None], moved, parameters), possible


@dataclass(frozen=True)
class _Problems:
    """Pairs as problems of least squares; parameters are those of :data:`_OWN_STD`, then the homography."""

    data: Measurements
    scale: FloatArray
    noise: FloatArray

    def take(self, rows: BoolArray | IntArray) -> Self:
        """Some of them."""
        return type(self)(self.data.take(rows), self.scale[rows], self.noise[rows])

    def normal_equations(self, parameters: FloatArray) -> BatchedNormalEquations:
        """Loss, normal matrix and gradient; the lens has priors."""
        found = differentiate(*_parts(parameters), self.data)
        entries = entry_equations(found, self.data.present, self.scale, True)
        chain = _chain(parameters)
        information = np.swapaxes(chain, 1, 2) @ entries.information @ chain
        gradient = np.einsum("bkp,bk->bp", chain, entries.gradient)
        lens, weight = parameters[:, :_LENS] / _OWN_STD, self.noise**2
        information[:, :_LENS, :_LENS] += weight[:, None, None] * np.diag(_OWN_STD**-2.0)
        gradient[:, :_LENS] += weight[:, None] * lens / _OWN_STD
        cost = entries.cost + weight * (lens**2).sum(axis=1)
        return BatchedNormalEquations(cost, information, gradient, entries.squared)

    def influence(self, parameters: FloatArray) -> FloatArray:
        """Each match's share of the gradient, (B, N, P)."""
        found = differentiate(*_parts(parameters), self.data)
        return influence(found, self.data.present, self.scale, True) @ _chain(parameters)


def _parts(parameters: FloatArray) -> tuple[FloatArray, PairLenses]:
    """Homographies and lenses."""
    first, second, mu = parameters[:, :3].T
    return _HOMOGRAPHY.homography(parameters[:, _LENS:]), PairLenses(first, second, mu, parameters[:, 3:_LENS])


def _chain(parameters: FloatArray) -> FloatArray:
    """Derivative of the entries of H and the lens by the parameters of a step, (B, 9 + 5, 5 + 8)."""
    chain = np.zeros((len(parameters), 9 + _LENS, _LENS + 8))
    chain[:, :9, _LENS:] = _HOMOGRAPHY.jacobian(parameters[:, _LENS:])
    chain[:, 9:, :_LENS] = np.eye(_LENS)
    return chain
