"""Which model of the family describes each of many pairs: the least free one that explains the data."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.geometry.division_model import OBSERVABLE_STD
from rdstitch.robust.loss import loss_width
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.pair_models import HomographyPairModel, PairModel, PlanarPairModel
from rdstitch.robust.posterior import LENS, Evidence, farthest_error
from rdstitch.robust.refinement import Fits, PairEquations, PairProblems, refine_pairs

_STEPS = 20  # of refinement; halved or doubled, the median error of λ changes by a sixth at most


@dataclass(frozen=True, eq=False)
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
    equations: PairEquations


@dataclass(frozen=True, eq=False)
class PairSelection:
    """B pairs for which a model is to be chosen."""

    homography: FloatArray  # (B, 3, 3): where to start
    distortion: FloatArray  # (B,): where to start, or what λ is known to be
    data: Measurements
    tilts: FloatArray | None  # (B, 2, 2): known tilts (ψ, θ) of both images, radians
    noise: FloatArray | None  # (B,): standard deviation of the errors per axis, pixels; None: as each fit finds it
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
            noise=None if self.noise is None else self.noise[rows],
        )

    def problems(self, model: PairModel) -> PairProblems:
        """To fit a model to every pair."""
        limit = np.full(len(self.data), self.threshold)
        width = limit if self.noise is None else loss_width(self.noise, limit)
        return PairProblems(model, self.data, width, self.noise, self.fixed_distortion)

    def fit(self, model: PairModel) -> _Fitted:
        """A model fitted to every pair from where it stands."""
        start = Fits(model.initialize(self.homography, self.tilts), self.homography, self.distortion)
        return _Fitted(model, *refine_pairs(self.problems(model), start, _STEPS))

    def at(self, fits: Fits) -> Self:
        """Standing at fits."""
        return replace(self, homography=fits.homography, distortion=fits.distortion)


def select_models(planar: Sequence[PlanarPairModel], pairs: PairSelection) -> list[PairFit]:
    """Fit every model to each pair, and choose the one with the best posterior (:mod:`rdstitch.robust.posterior`).

    The planar ones, from least to most free, compete with the free homography. The noise, and which matches are near
    enough to count, are those of the latter, so that a more restricted model is compared with what the images allow and
    not with its own misfit.
    """
    freest = pairs.fit(HomographyPairModel())
    errors, noise = freest.equations.errors, freest.equations.noise
    row, column = np.nonzero(pairs.data.present & (errors < farthest_error(pairs.data.px)[:, None]))
    near = np.zeros_like(pairs.data.present)
    near[row, column] = True
    standing = replace(pairs.at(freest.fits), noise=noise, data=pairs.data.only(near))
    fitted = [*(standing.fit(model) for model in planar), freest]
    every = np.arange(len(pairs.data))
    evidence = Evidence.of(row, pairs.data.x1[row, :, column], every, noise, pairs.data.px)
    chosen = np.argmin([_score(each, evidence, row, column, pairs.fixed_distortion) for each in fitted], axis=0)
    rms = np.stack([rms_of(each.equations.errors, pairs.threshold) for each in fitted], axis=1)
    result: dict[int, PairFit] = {}

    def finished(index: int, rows: IntArray, why: str) -> dict[int, PairFit]:
        model, fits, equations = fitted[index]
        fits = fits.take(rows)
        selected = pairs.at(fitted[index].fits).take(rows)
        if index < len(planar):  # on all matches, with the noise that it leaves itself
            equations = selected.problems(model).normal_equations(fits.parameters)
        else:
            equations = equations.take(rows)
        reasons = [_explained(fitted, index, rms[k], why) for k in rows]
        return dict(zip(rows.tolist(), _finished(_Fitted(model, fits, equations), selected, reasons), strict=True))

    for index in range(len(fitted)):
        rows = np.flatnonzero(chosen == index)
        if len(rows):
            free = index == len(fitted) - 1
            why = (
                "no model with less freedom explains the data"
                if free
                else "the least free model that explains the data"
            )
            result.update(finished(index, rows, why))
    # A camera that turns on the spot moves like one beside a plane seen edge on, where tilt, focal length and λ cannot
    # be distinguished; as a free homography the same images may show λ well.
    unseen = [row for row, fit in result.items() if chosen[row] < len(planar) and np.isinf(fit.distortion_std)]
    if unseen:
        why = "models with less freedom explain the data, and do not show λ"
        free_fits = finished(len(planar), np.array(sorted(unseen), dtype=np.intp), why)
        result.update({row: fit for row, fit in free_fits.items() if np.isfinite(fit.distortion_std)})
    return [result[row] for row in range(len(pairs.data))]


def _score(fitted: _Fitted, evidence: Evidence, row: IntArray, column: IntArray, fixed_distortion: bool) -> FloatArray:
    """-2 log of the posterior of a model of each pair (B,), by the matches at these places, up to a constant."""
    equations, distortion = fitted.equations, fitted.fits.distortion
    seen = evidence.cost(equations.transferred.whitened(row, column), equations.information.shape[1])
    lens = np.zeros(len(distortion)) if fixed_distortion else np.array([LENS[0].cost(x) for x in distortion.tolist()])
    return seen.cost + equations.prior + lens


def _finished(fitted: _Fitted, pairs: PairSelection, reasons: list[str]) -> list[PairFit]:
    """The chosen model with its covariance, and without λ where that is not observable.

    ``fitted``: to all matches; ``pairs``: standing at the fits; ``reasons``: why this model was chosen, for each pair.
    """
    covariance = pairs.problems(fitted.model).covariances(fitted.fits.parameters, fitted.equations)
    std = np.zeros(len(reasons)) if pairs.fixed_distortion else np.sqrt(covariance[:, 0, 0])
    result = _listed(fitted, covariance, std, reasons)
    unseen = np.flatnonzero(~(std < OBSERVABLE_STD))
    if len(unseen):
        level = replace(pairs.take(unseen), distortion=np.zeros(len(unseen)), fixed_distortion=True)
        again = level.fit(fitted.model)
        covariance = level.problems(fitted.model).covariances(again.fits.parameters, again.equations)
        why = [
            f"{reasons[row]}; λ is not observable (standard deviation {std[row]:.2g}) and was set to 0"
            for row in unseen.tolist()
        ]
        for row, fit in zip(unseen.tolist(), _listed(again, covariance, np.full(len(why), np.inf), why), strict=True):
            result[row] = fit
    return result


def _listed(fitted: _Fitted, covariance: FloatArray, std: FloatArray, reasons: list[str]) -> list[PairFit]:
    model, fits, errors = fitted.model, fitted.fits, fitted.equations.errors
    columns = fits.state, fits.homography, fits.distortion.tolist(), errors, covariance, std.tolist(), reasons
    return [PairFit(model, *row) for row in zip(*columns, strict=True)]


def rms_of(errors: FloatArray, threshold: float) -> FloatArray:
    """Root mean squares of the errors (B, N) below the threshold, pixels, (B,); NaN where there are none."""
    inside = errors < threshold
    count = inside.sum(axis=1)
    total = np.square(np.where(inside, errors, 0.0)).sum(axis=1)
    return np.asarray(np.sqrt(np.where(count > 0, total, np.nan) / np.maximum(count, 1)))


def _explained(fitted: list[_Fitted], chosen: int, rms: FloatArray, why: str) -> str:
    """Which model was chosen and why, with the errors that each leaves."""
    listed = ", ".join(f"{one.model.name} {value:.2f} pixels" for one, value in zip(fitted, rms, strict=True))
    return f"{fitted[chosen].model.name}: {why} (rms {listed})"
