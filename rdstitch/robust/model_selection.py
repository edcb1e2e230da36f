"""Which model of the family describes each of many pairs: the least free one that explains the data."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rdstitch.arrays import FloatArray, IntArray, Rows
from rdstitch.geometry.division_model import OBSERVABLE_STD
from rdstitch.numerics.robust_loss import loss_width
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.pair_models import HomographyPairModel, PairModel, PlanarPairModel
from rdstitch.robust.posterior import Evidence, farthest_error
from rdstitch.robust.priors import LENS_PRIORS, prior_costs
from rdstitch.robust.refinement import PairEquations, PairProblems, descend

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


@dataclass(frozen=True, eq=False)
class StartedPairs(Rows):
    """B pairs for which a model is to be chosen, and where its fit starts."""

    data: Measurements
    homography: FloatArray  # (B, 3, 3)
    distortion: FloatArray  # (B,): where to start, or what λ is known to be
    tilts: FloatArray | None = None  # (B, 2, 2): known tilts (ψ, θ) of both images, radians
    noise: FloatArray | None = None  # (B,): standard deviation of the errors per axis, pixels; None: as each fit has it


class _Fitted(NamedTuple):
    """One model fitted to B pairs: parameters, and the equations there."""

    problems: PairProblems
    parameters: FloatArray
    equations: PairEquations

    @property
    def name(self) -> str:
        return self.problems.model.name

    def start(self, pairs: StartedPairs) -> StartedPairs:
        """The pairs where it stands."""
        return replace(pairs, homography=self.problems.homography(self.parameters), distortion=self.parameters[:, 0])


@dataclass(frozen=True)
class ModelSelection:
    """How models are fitted to pairs, and compared."""

    threshold: float  # largest transfer error of an inlier, pixels
    fixed_distortion: bool = False  # whether λ is known

    def select(self, planar: Sequence[PlanarPairModel], pairs: StartedPairs) -> list[PairFit]:
        """Fit every model to each pair, and choose that with the best posterior (:mod:`rdstitch.robust.posterior`).

        The planar ones, from least to most free, compete with the free homography. The noise, and which matches are
        near enough to count, are those of the latter, so that a more restricted model is compared with what the images
        allow and not with its own misfit.
        """
        freest = self._fit(HomographyPairModel(), pairs)
        errors, noise = freest.equations.errors, freest.equations.noise
        row, column = np.nonzero(pairs.data.present & (errors < farthest_error(pairs.data.px)[:, None]))
        near = np.zeros_like(pairs.data.present)
        near[row, column] = True
        start = replace(freest.start(pairs), noise=noise, data=pairs.data.only(near))
        fitted = [*(self._fit(model, start) for model in planar), freest]
        every = np.arange(len(pairs.data))
        evidence = Evidence.of(row, pairs.data.x1[row, :, column], every, noise, pairs.data.px)
        chosen = np.argmin([self._cost(each, evidence, row, column) for each in fitted], axis=0)
        rms = np.stack([rms_of(each.equations.errors, self.threshold) for each in fitted], axis=1)

        def finished(index: int, rows: IntArray, why: str) -> dict[int, PairFit]:
            errors = (
                ", ".join(f"{one.name} {e:.2f} pixels" for one, e in zip(fitted, rms[k], strict=True)) for k in rows
            )
            reasons = [f"{fitted[index].name}: {why} (rms {listed})" for listed in errors]
            selected, parameters = fitted[index].start(pairs).take(rows), fitted[index].parameters[rows]
            # On all matches, with the noise that it leaves itself.
            problems = self._problems(fitted[index].problems.model, selected)
            whole = _Fitted(problems, parameters, problems.normal_equations(parameters))
            return dict(zip(rows.tolist(), self._finished(whole, selected, reasons), strict=True))

        result: dict[int, PairFit] = {}
        for index in range(len(fitted)):
            if len(rows := np.flatnonzero(chosen == index)):
                free = index == len(planar)
                why = f"{'no model with less freedom' if free else 'the least free model that'} explains the data"
                result.update(finished(index, rows, why))
        return [result[row] for row in range(len(pairs.data))]

    def _problems(self, model: PairModel, pairs: StartedPairs) -> PairProblems:
        limit = np.full(len(pairs.data), self.threshold)
        width = limit if pairs.noise is None else loss_width(pairs.noise, limit)
        return PairProblems(model, pairs.data, width, pairs.noise, self.fixed_distortion)

    def _fit(self, model: PairModel, pairs: StartedPairs) -> _Fitted:
        problems = self._problems(model, pairs)
        start = problems.start(pairs.homography, pairs.distortion, pairs.tilts)
        return _Fitted(problems, *descend(problems, start, _STEPS))

    def _cost(self, fitted: _Fitted, evidence: Evidence, row: IntArray, column: IntArray) -> FloatArray:
        """-2 log of the posterior of a model of each pair (B,), by the matches at these places, up to a constant."""
        equations, distortion = fitted.equations, fitted.parameters[:, :1]
        priors = equations.prior + (0.0 if self.fixed_distortion else prior_costs(LENS_PRIORS[:1], distortion)[:, 0])
        return evidence.cost(equations.transferred.whitened(row, column), equations.information.shape[1], priors)

    def _finished(self, fitted: _Fitted, pairs: StartedPairs, reasons: list[str]) -> list[PairFit]:
        """The chosen model with its covariance, and without λ where that is not observable."""
        result = _listed(fitted, np.zeros(len(reasons)) if self.fixed_distortion else None, reasons)
        unseen = [row for row, fit in enumerate(result) if not fit.distortion_std < OBSERVABLE_STD]
        if unseen:
            level = replace(pairs.take(np.array(unseen)), distortion=np.zeros(len(unseen)))
            again = replace(self, fixed_distortion=True)._fit(fitted.problems.model, level)
            why = [
                f"{reasons[row]}; λ is not observable (standard deviation {result[row].distortion_std:.2g}) "
                "and was set to 0"
                for row in unseen
            ]
            for row, fit in zip(unseen, _listed(again, np.full(len(why), np.inf), why), strict=True):
                result[row] = fit
        return result


def _listed(fitted: _Fitted, std: FloatArray | None, reasons: list[str]) -> list[PairFit]:
    """The pairs one by one; the standard deviations of λ (B,) are those of the covariance if not given."""
    problems, parameters, equations = fitted
    covariance = problems.covariances(parameters, equations)
    std = np.sqrt(covariance[:, 0, 0]) if std is None else std
    homography, distortion = problems.homography(parameters), parameters[:, 0].tolist()
    columns = parameters[:, 1:], homography, distortion, equations.errors, covariance, std.tolist(), reasons
    return [PairFit(problems.model, *row) for row in zip(*columns, strict=True)]


def rms_of(errors: FloatArray, threshold: float) -> FloatArray:
    """Root mean squares of the errors (B, N) below the threshold, pixels, (B,); NaN where there are none."""
    inside = errors < threshold
    count = inside.sum(axis=1)
    total = np.square(np.where(inside, errors, 0.0)).sum(axis=1)
    return np.asarray(np.sqrt(np.where(count > 0, total, np.nan) / np.maximum(count, 1)))
