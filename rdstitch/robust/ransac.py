"""RANSAC over several minimal solvers at once: sample, solve, score, optimise locally, stop when confident."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.robust.local_optimization import refine
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.minimal import MinimalSolver
from rdstitch.robust.pair_models import HomographyModel, PairModel
from rdstitch.robust.sampling import Sampler
from rdstitch.robust.scoring import plausible, transfer_errors2, truncated_costs
from rdstitch.solvers.solutions import Solutions

_FIRST_BATCH = 32
_LARGEST_BATCH = 512
_LEAST_EXPLORATION = 96  # samples that every solver draws unless its own confidence is reached before
_QUICK_SCORE = 384  # correspondences on which hypotheses are compared before the best are scored on all
_SOLVER_SUCCESS = 0.8  # share of all-inlier samples that lead to the model, in the face of noise
_NOVELTY = 0.1  # share of a hypothesis's inliers that must be new for it to be worth optimising
_FREE_REFINEMENT = 12  # inliers from which on refinement may leave the model that the minimal solver assumes


@dataclass(frozen=True)
class RansacOptions:
    """When to stop, and what counts as agreement."""

    threshold: float = 3.0  # px: largest transfer error of an inlier
    confidence: float = 0.999  # probability that a better model was not missed
    max_iterations: int = 10000  # samples, over all solvers
    seed: int = 0
    least_inliers: int = 8  # a model with fewer would not be accepted, so none such is searched for


@dataclass(frozen=True)
class Hypothesis:
    """A homography with λ, and how well it explains the correspondences.

    Attributes
    ----------
    homography : ndarray of shape (3, 3)
        In the half-diagonal frame.
    distortion : float
    cost : float
        Mean truncated loss: 1 where nothing fits, 0 where all fits exactly.
    inliers : ndarray of shape (N,), bool
    solver : str
        Name of the minimal solver that found it.
    """

    homography: FloatArray
    distortion: float
    cost: float
    inliers: NDArray[np.bool_]
    solver: str

    @property
    def inlier_share(self) -> float:
        """Share of the correspondences that agree."""
        return float(self.inliers.mean())

    def repeats(self, other: "Hypothesis") -> bool:
        """Whether it explains hardly anything that the other does not explain."""
        return int((self.inliers & ~other.inliers).sum()) <= _NOVELTY * int(self.inliers.sum())


@dataclass(frozen=True)
class Search:
    """What RANSAC found.

    Attributes
    ----------
    best : Hypothesis or None
        None where no sample gave a plausible model.
    iterations : int
        Samples drawn.
    confident : bool
        Whether the search stopped because it was confident, not because ``max_iterations`` was reached.
    """

    best: Hypothesis | None
    iterations: int
    confident: bool


def ransac(solvers: list[MinimalSolver], data: Measurements, options: RansacOptions) -> Search:
    """Search the model that explains most correspondences, with all solvers taking turns.

    Solvers with fewer points need fewer samples but assume more of the motion. They share the best model so far, so
    that as soon as one of them is confident, and each has had a look, all are done.

    Parameters
    ----------
    solvers : list of MinimalSolver
        Those that need more correspondences than there are do not take part.
    data : Measurements
    options : RansacOptions
    """
    lanes = [
        _Lane(solver, data, options, index) for index, solver in enumerate(solvers) if solver.sample_size <= len(data)
    ]
    best: Hypothesis | None = None
    iterations, batch = 0, _FIRST_BATCH
    while lanes and iterations < options.max_iterations:
        for lane in lanes:
            if lane.drawn < max(_LEAST_EXPLORATION, lane.needed(best)):
                best = lane.advance(batch, best)
        iterations = sum(lane.drawn for lane in lanes)
        explored = all(lane.drawn >= min(_LEAST_EXPLORATION, lane.needed(best)) for lane in lanes)
        if explored and any(lane.drawn >= lane.needed(best) for lane in lanes):
            return Search(best, iterations, True)
        batch = min(2 * batch, _LARGEST_BATCH)
    return Search(best, iterations, False)


class _Lane:
    """One minimal solver's share of the search."""

    def __init__(self, solver: MinimalSolver, data: Measurements, options: RansacOptions, index: int) -> None:
        self.drawn = 0
        self._solver = solver
        self._data = data
        self._options = options
        self._least_raw_cost = np.inf
        self._sampler = Sampler(
            len(data), solver.sample_size, data.quality, options.max_iterations, [options.seed, index]
        )
        self._quick = _subset(data, options.seed)

    def needed(self, best: Hypothesis | None) -> float:
        """Samples after which a better model than the best is unlikely to have been missed."""
        least = self._options.least_inliers / len(self._data)
        share = least if best is None else max(best.inlier_share, least)
        good = _SOLVER_SUCCESS * min(share, 1.0) ** self._solver.sample_size
        return float(np.log1p(-self._options.confidence) / np.log1p(-min(good, 1.0 - 1e-12)))

    def advance(self, batch: int, best: Hypothesis | None) -> Hypothesis | None:
        """Draw a batch of samples and return the best hypothesis so far."""
        picks = self._sampler.draw(batch)
        self.drawn += batch
        found = self._solver.solve(self._data.x1[picks], self._data.x2[picks])
        keep = plausible(found, corner_radius=1.0)
        found = Solutions(found.sample[keep], found.homography[keep], found.distortion[keep])
        if not len(found):
            return best
        costs = truncated_costs(found, self._quick, self._options.threshold)
        first = int(np.argmin(costs))
        if costs[first] >= min(self._least_raw_cost, 1.0):
            return best
        self._least_raw_cost = float(costs[first])
        candidate = self._judge(found.homography[first], float(found.distortion[first]))
        if best is not None and candidate.cost > best.cost and candidate.repeats(best):
            return best
        candidate = self._optimize(candidate)
        return candidate if best is None or candidate.cost < best.cost else best

    def _optimize(self, start: Hypothesis) -> Hypothesis:
        """The best of a hypothesis, its refinement in the model it assumes, and from there as a free homography."""
        best = self._refined(start, self._solver.model, 3.0 * self._options.threshold)
        enough = best.inlier_share * len(self._data) >= _FREE_REFINEMENT
        return self._refined(best, HomographyModel() if enough else self._solver.model, self._options.threshold)

    def _refined(self, start: Hypothesis, model: PairModel, scale: float) -> Hypothesis:
        """The start or its refinement, whichever is better."""
        fit = refine(
            model,
            start.homography,
            start.distortion,
            self._data,
            scale,
            fixed_distortion=self._solver.fixed_distortion,
            iterations=4,
        )
        refined = self._judge(fit.homography, fit.distortion)
        return refined if refined.cost < start.cost else start

    def _judge(self, homography: FloatArray, distortion: float) -> Hypothesis:
        errors2 = transfer_errors2(homography[None], np.array([distortion]), self._data)[0]
        relative = np.minimum(errors2 / self._options.threshold**2, 1.0)
        return Hypothesis(homography, distortion, float(relative.mean()), relative < 1.0, self._solver.name)


def _subset(data: Measurements, seed: int) -> Measurements:
    """At most ``_QUICK_SCORE`` correspondences, for a first comparison of many hypotheses."""
    if len(data) <= _QUICK_SCORE:
        return data
    chosen = np.sort(np.random.default_rng([seed, 1 << 20]).choice(len(data), _QUICK_SCORE, replace=False))
    return data.subset(chosen)
