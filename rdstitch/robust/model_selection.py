"""Which model of the family describes each of many pairs: the least free one that explains the data."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.division_model import OBSERVABLE_STD
from rdstitch.robust.covariance import covariances
from rdstitch.robust.levenberg_marquardt import BatchedNormalEquations
from rdstitch.robust.loss import PAIR_WIDTH, RAYLEIGH_MEDIAN
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.pair_models import HomographyPairModel, PairModel, PlanarPairModel
from rdstitch.robust.refinement import Fits, PairProblems, refine_pairs

# Halved or doubled, these change the median error of λ by a sixth at most.
_MIN_NOISE = 0.02  # pixels; below, noise-free data would reject every model over rounding
_MAX_RESIDUAL = 3.0  # errors, in thresholds, beyond which a match is left out of the choice
_FREE_STEPS, _STEPS = 8, 15


@dataclass(frozen=True)
class PairFit:
    """The chosen model of one pair, fitted."""

    model: PairModel
    state: FloatArray  # (S,)
    homography: FloatArray  # (3, 3)
    distortion: float
    errors: FloatArray  # (N,): whitened transfer errors, pixels; inf where there is no transfer
    covariance: FloatArray  # (P, P): of λ (first, where it was estimated) and the model's parameters
    distortion_std: float  # standard deviation of λ; 0 where it was given, inf where it is not observable (λ is then 0)
    reason: str


class _Fitted(NamedTuple):
    """One model fitted to B pairs, and the equations at the fits."""

    model: PairModel
    fits: Fits
    equations: BatchedNormalEquations


@dataclass(frozen=True)
class PairSelection:
    """B pairs for which a model is to be chosen."""

    homography: FloatArray  # (B, 3, 3): where to start
    distortion: FloatArray  # (B,): where to start, or what λ is known to be
    data: Measurements
    tilts: FloatArray | None  # (B, 2, 2): known tilts (ψ, θ) of both images, radians
    noise: FloatArray  # (B,): standard deviation of the errors per axis, pixels
    threshold: float  # largest transfer error of an inlier, pixels
    fixed_distortion: bool  # whether λ is known

    def take(self, rows: IntArray) -> Self:
        """Some of the pairs."""
        tilts = None if self.tilts is None else self.tilts[rows]
        return replace(
            self,
            homography=self.homography[rows],
            distortion=self.distortion[rows],
            data=self.data.take(rows),
            tilts=tilts,
            noise=self.noise[rows],
        )

    def fit(self, model: PairModel, width: FloatArray, steps: int, *, rough: bool = False) -> _Fitted:
        """A model fitted to every pair from where it stands, with a loss of the given widths (B,), pixels."""
        start = Fits(model.initialize(self.homography, self.tilts), self.homography, self.distortion)
        problems = PairProblems(model, self.data, width, self.noise, self.fixed_distortion)
        return _Fitted(model, *refine_pairs(problems, start, steps, rough=rough))

    def at(self, fits: Fits) -> Self:
        """Standing at fits."""
        return replace(self, homography=fits.homography, distortion=fits.distortion)


def select_models(planar: Sequence[PlanarPairModel], pairs: PairSelection) -> list[PairFit]:
    """Fit every model to each pair and choose by the Bayesian information criterion.

    The noise is that of the freest model, so that a more restricted model is compared with what the images allow and
    not with its own misfit.

    Parameters
    ----------
    planar : sequence of PlanarPairModel
        From least to most free; they compete with the free homography.
    pairs : PairSelection
        ``noise`` is estimated anew.
    """
    threshold, homography = pairs.threshold, HomographyPairModel()
    # The search ends near one plane of several; without its own fit a pair with depth keeps a sixth fewer inliers.
    free = pairs.fit(homography, np.full(len(pairs.data), threshold), _FREE_STEPS, rough=True)
    errors = free.equations.errors
    noise = noise_of(errors, threshold)
    near = replace(pairs.at(free.fits), noise=noise, data=pairs.data.only(errors < _MAX_RESIDUAL * threshold))
    inliers = np.maximum((errors < threshold).sum(axis=1), 1)
    width, price = loss_width(noise, threshold), noise**2 * np.log(2 * inliers)
    freest = near.fit(homography, width, _STEPS)
    fitted = [*(near.fit(model, width, _STEPS) for model in planar), freest]
    chosen = np.argmin([each.equations.cost + each.equations.information.shape[1] * price for each in fitted], axis=0)
    rms = np.stack([rms_of(each.equations.errors, threshold) for each in fitted], axis=1)
    result: dict[int, PairFit] = {}

    def finished(index: int, rows: IntArray) -> dict[int, PairFit]:
        model, fits, equations = fitted[index]
        standing = replace(near.at(fits), noise=noise_of(equations.errors, threshold)).take(rows)
        reasons = [_explained(fitted, index, rms[row]) for row in rows]
        chosen_fits = _finished(model, fits.take(rows), standing, pairs.data.take(rows), reasons)
        return dict(zip(rows.tolist(), chosen_fits, strict=True))

    for index in range(len(fitted)):
        rows = np.flatnonzero(chosen == index)
        if len(rows):
            result.update(finished(index, rows))
    # A camera that turns on the spot moves like one beside a plane seen edge on, where tilt, focal length and λ cannot
    # be distinguished; as a free homography the same images may show λ well.
    unseen = [row for row, fit in result.items() if chosen[row] < len(planar) and np.isinf(fit.distortion_std)]
    if unseen:
        free_fits = finished(len(planar), np.array(sorted(unseen), dtype=np.intp))
        result.update({row: fit for row, fit in free_fits.items() if np.isfinite(fit.distortion_std)})
    return [result[row] for row in range(len(pairs.data))]


def _finished(
    model: PairModel, fits: Fits, near: PairSelection, data: Measurements, reasons: list[str]
) -> Iterator[PairFit]:
    """The chosen model with its covariance, and without λ where that is not observable.

    Parameters
    ----------
    model : PairModel
    fits : Fits
    near : PairSelection
        Standing at the fits; with the matches that the choice was made by.
    data : Measurements
        All matches.
    reasons : list of str
        Why this model was chosen, for each pair.
    """
    errors, covariance = _inspected(model, fits, near, data)
    std = np.zeros(len(data)) if near.fixed_distortion else np.sqrt(covariance[:, 0, 0])
    known = [(fits, row, errors[row], covariance[row], std[row], reason) for row, reason in enumerate(reasons)]
    unseen = np.flatnonzero(~(std < OBSERVABLE_STD))
    if len(unseen):
        level = replace(near.take(unseen), distortion=np.zeros(len(unseen)), fixed_distortion=True)
        straight = level.fit(model, loss_width(level.noise, near.threshold), _STEPS).fits
        errors, covariance = _inspected(model, straight, level, data.take(unseen))
        for index, row in enumerate(unseen.tolist()):
            why = f"{reasons[row]}; λ is not observable (standard deviation {std[row]:.2g}) and was set to 0"
            known[row] = straight, index, errors[index], covariance[index], np.inf, why
    for fit, k, error, spread, deviation, why in known:
        distortion = float(fit.distortion[k])
        yield PairFit(model, fit.state[k], fit.homography[k], distortion, error, spread, float(deviation), why)


def _inspected(model: PairModel, fits: Fits, pairs: PairSelection, data: Measurements) -> tuple[FloatArray, FloatArray]:
    """Errors and covariances of fits as they stand, on all matches."""
    width = loss_width(pairs.noise, pairs.threshold)
    problems = PairProblems(model, data, width, pairs.noise, pairs.fixed_distortion)
    equations, shares = problems.inspect(fits.parameters)
    return equations.errors, covariances(equations.information, shares, pairs.noise, data)


def noise_of(errors: FloatArray, threshold: float) -> FloatArray:
    """Standard deviations per axis, pixels, (B,), from the median of the errors (B, N) below the threshold."""
    inside = errors < threshold
    count = inside.sum(axis=1)
    ordered = np.sort(np.where(inside, errors, np.inf), axis=1)
    middle = np.stack([np.maximum(count - 1, 0) // 2, count // 2], axis=1)
    middle = np.minimum(middle, errors.shape[1] - 1)
    median = np.take_along_axis(ordered, middle, axis=1).mean(axis=1)
    return np.where(count > 0, np.maximum(median / RAYLEIGH_MEDIAN, _MIN_NOISE), _MIN_NOISE)


def loss_width(noise: FloatArray, threshold: float) -> FloatArray:
    """Scales of the loss, pixels, for errors of these standard deviations per axis."""
    return np.minimum(threshold, PAIR_WIDTH * noise)


def rms_of(errors: FloatArray, threshold: float) -> FloatArray:
    """Root mean squares of the errors (B, N) below the threshold, pixels, (B,); NaN where there are none."""
    inside = errors < threshold
    count = inside.sum(axis=1)
    total = np.square(np.where(inside, errors, 0.0)).sum(axis=1)
    return np.asarray(np.sqrt(np.where(count > 0, total, np.nan) / np.maximum(count, 1)))


def _explained(fitted: list[_Fitted], chosen: int, rms: FloatArray) -> str:
    """One clause on why this model and not another."""
    listed = ", ".join(f"{one.model.name} {value:.2f} pixels" for one, value in zip(fitted, rms, strict=True))
    why = "no model with less freedom" if chosen == len(fitted) - 1 else "the least free model that"
    return f"{fitted[chosen].model.name}: {why} explains the data (rms {listed})"
