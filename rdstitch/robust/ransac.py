"""RANSAC over several minimal solvers and many pairs: sample, solve, score, optimise locally, stop when confident.

The pairs go on in lockstep, each until it is confident; no pair's result depends on the others.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray, Rows
from rdstitch.options.estimation_options import EstimationOptions
from rdstitch.robust.chance import MIN_OCCUPIED_CELLS
from rdstitch.robust.measurements import Measurements
from rdstitch.robust.minimal import MinimalSolver
from rdstitch.robust.pair_models import HomographyPairModel, PairModel
from rdstitch.robust.refinement import PairProblems, descend
from rdstitch.robust.sampling import Sampler
from rdstitch.robust.scoring import plausible, transfer_errors2, truncated_costs
from rdstitch.solvers.solutions import Solutions

# Halved or doubled, none of these changes what is found, only the time.
_FIRST_BATCH = 48  # samples of the first round; every round has twice as many as the one before
# samples of a round at the most, and of the solver that assumes least up to which it goes on alone if it needs no more
_MAX_BATCH = 512
_SAMPLES_AT_ONCE = 4096
_MIN_EXPLORATION = 96  # samples that every solver draws unless its own confidence is reached before
_QUICK_SCORE = 128  # matches on which hypotheses are compared before the best are scored on all
_SOLVER_SUCCESS = 0.8  # fraction of all-inlier samples that lead to the model, in the face of noise
_NOVELTY = 0.1  # fraction of a hypothesis's inliers that must be new for it to be worth optimising
_FREE_REFINEMENT = 12  # inliers from which on refinement may leave the model that the minimal solver assumes
_LOCAL_STEPS = 4
_GOLDEN = 0.618034  # its multiples are spread evenly, whatever their number


@dataclass(eq=False)
class Hypotheses(Rows):
    """A homography with λ for each of B pairs, and how well it explains the matches."""

    homography: FloatArray  # (B, 3, 3): in the half-diagonal frame
    distortion: FloatArray  # (B,)
    # (B,): mean truncated loss: 1 where nothing fits, 0 where all fits exactly; inf where there is no hypothesis
    cost: FloatArray
    inliers: BoolArray  # (B, N), bool
    solver: IntArray  # (B,), intp: which minimal solver found it

    @classmethod
    def judged(
        cls, homography: FloatArray, distortion: FloatArray, data: Measurements, threshold: float, solver: int
    ) -> "Hypotheses":
        """Hypotheses on all matches of their pairs."""
        errors2 = transfer_errors2(homography, distortion, np.arange(len(data)), data)
        relative = np.minimum(errors2 / threshold**2, 1.0)
        relative[~data.present] = 1.0
        inliers = relative < 1.0
        missed = (relative * data.present).sum(axis=1)
        return cls(homography, distortion, missed / data.count, inliers, np.full(len(data), solver))


@dataclass(frozen=True, eq=False)
class Search:
    """What RANSAC found."""

    best: Hypotheses  # with infinite cost where no sample gave a plausible model
    iterations: IntArray  # (B,), intp: samples drawn
    # (B,), bool: whether the search stopped because it was confident, not because ``max_iterations`` was reached
    confident: BoolArray


def ransac(
    solvers: list[MinimalSolver],
    data: Measurements,
    ordered: BoolArray,
    tilts: FloatArray | None,
    options: EstimationOptions,
) -> Search:
    """Search the model that explains most matches of each pair, with all solvers taking turns.

    The last solver, which assumes least, begins; most pairs need no other. Solvers with fewer points need fewer samples
    but assume more of the motion: they join where it would need many. All share the best model so far, so that as soon
    as one of them is confident, and each has explored a little, the pair is done.

    ``data``: every pair has at least as many matches as the largest sample; ``ordered`` (B,) bool: whether the best
    matches of a pair come first; ``tilts`` (B, 2, 2): known tilts (ψ, θ) of both images, radians.
    """
    quick = _subset(data)
    states = [_SolverState(solver, data, quick, ordered, tilts, options, index) for index, solver in enumerate(solvers)]
    count = len(data)
    none, solver = np.zeros(data.present.shape, dtype=np.bool_), np.zeros(count, dtype=np.intp)
    best = Hypotheses(np.full((count, 3, 3), np.nan), np.zeros(count), np.full(count, np.inf), none, solver)
    confident, active = np.zeros(count, dtype=np.bool_), np.arange(count)
    batch, hard = _FIRST_BATCH, active[:0]
    while len(active):
        for one, rows in [*((one, hard) for one in states[:-1]), (states[-1], active)]:
            rows = rows[one.drawn[rows] < one.needed(best, rows, explore=True)]
            left = options.max_iterations - np.sum([each.drawn[rows] for each in states], axis=0)
            for size in np.unique(np.minimum(left, batch)).tolist():  # of each pair, whatever the others have drawn
                one.advance(best, rows[np.minimum(left, batch) == size], size)
        needed = np.stack([one.needed(best, active) for one in states])
        drawn = np.stack([one.drawn[active] for one in states])
        explored = (drawn >= np.minimum(_MIN_EXPLORATION, needed)).all(axis=0)
        # Where the solver that assumes least is confident, nothing is left to explore.
        sure = (drawn[-1] >= needed[-1]) | (explored & (drawn >= needed).any(axis=0))
        confident[active[sure]] = True
        going = ~sure & (drawn.sum(axis=0) < options.max_iterations)
        active, hard = active[going], active[going & (needed[-1] > _MAX_BATCH)]
        batch = min(2 * batch, _MAX_BATCH)
    return Search(best, np.sum([one.drawn for one in states], axis=0), confident)


@dataclass(eq=False)
class _SolverState:
    """What one minimal solver has searched."""

    solver: MinimalSolver
    data: Measurements
    quick: Measurements  # a part of the matches
    ordered: BoolArray
    tilts: FloatArray | None
    options: EstimationOptions
    index: int  # of the solver

    def __post_init__(self) -> None:
        self.drawn = np.zeros(len(self.data), dtype=np.intp)
        self._min_raw_cost = np.ones(len(self.data))

    @cached_property
    def _sampler(self) -> Sampler:
        return Sampler(self.solver.sample_size, self.options.max_iterations, [self.options.seed, self.index])

    def needed(self, best: Hypotheses, rows: IntArray, *, explore: bool = False) -> FloatArray:
        """Samples after which a better model of some pairs was hardly missed; ``explore``: that all solvers draw."""
        counts = self.data.count[rows]
        agreeing = np.maximum(best.inliers[rows].sum(axis=1), MIN_OCCUPIED_CELLS)
        good = _SOLVER_SUCCESS * np.minimum(agreeing / counts, 1.0) ** self.solver.sample_size
        needed = np.log1p(-self.options.confidence) / np.log1p(-np.minimum(good, 1.0 - 1e-12))
        return np.asarray(np.maximum(needed, _MIN_EXPLORATION) if explore else needed)

    def advance(self, best: Hypotheses, rows: IntArray, batch: int) -> None:
        """Draw a batch of samples of some pairs, and put the best hypotheses where they are better."""
        if not len(rows) or batch < 1:
            return
        picks = self._sampler.draw(self.drawn[rows], batch, self.data.count[rows], self.ordered[rows])
        self.drawn[rows] += batch
        step = max(1, _SAMPLES_AT_ONCE // batch)
        hypotheses = [self._best_of(rows[i : i + step], picks[i : i + step]) for i in range(0, len(rows), step)]
        homography, distortion, cost = (np.concatenate(column) for column in zip(*hypotheses, strict=True))
        better = cost < self._min_raw_cost[rows]
        rows, homography, distortion = rows[better], homography[better], distortion[better]
        self._min_raw_cost[rows] = cost[better]
        if not len(rows):
            return
        data, threshold = self.data.take(rows), self.options.threshold
        judged = Hypotheses.judged(homography, distortion, data, threshold, self.index)
        fresh = (judged.inliers & ~best.inliers[rows]).sum(axis=1) > _NOVELTY * judged.inliers.sum(axis=1)
        worthwhile = np.flatnonzero(fresh | ~(judged.cost > best.cost[rows]))
        if len(worthwhile):
            optimized = self._optimized(judged.take(worthwhile), data.take(worthwhile), rows[worthwhile])
            better = optimized.cost < best.cost[rows[worthwhile]]
            best.put(rows[worthwhile][better], optimized.take(better))

    def _best_of(self, rows: IntArray, picks: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The hypothesis of each pair that explains a part of its matches best: H, λ and cost; inf where none is."""
        _, batch, size = picks.shape
        chosen = picks.reshape(len(rows), 1, -1)
        x1, x2 = (
            np.take_along_axis(x[rows], chosen, axis=2).reshape(len(rows), 2, batch, size).transpose(0, 2, 3, 1)
            for x in (self.data.x1, self.data.x2)
        )
        tilts = None if self.tilts is None else np.repeat(self.tilts[rows], batch, axis=0)
        solutions = self.solver.solve(x1.reshape(-1, size, 2), x2.reshape(-1, size, 2), tilts)
        # A lens that is known may see beyond the horizon at the corners: what is there is no inlier.
        keep = plausible(solutions, corner_radius=0.0 if self.solver.fixed_distortion else 1.0)
        solutions = Solutions(solutions.sample[keep], solutions.homography[keep], solutions.distortion[keep])
        pair = solutions.sample // batch
        costs = truncated_costs(
            solutions.homography, solutions.distortion, pair, self.quick.take(rows), self.options.threshold
        )
        order = np.lexsort((costs, pair))
        first = order[np.flatnonzero(np.diff(pair[order], prepend=-1))]
        homography, distortion = np.zeros((len(rows), 3, 3)), np.zeros(len(rows))
        min_cost = np.full(len(rows), np.inf)
        which = pair[first]
        homography[which], distortion[which] = solutions.homography[first], solutions.distortion[first]
        min_cost[which] = costs[first]
        return homography, distortion, min_cost

    def _optimized(self, start: Hypotheses, data: Measurements, rows: IntArray) -> Hypotheses:
        """Each hypothesis or its refinement, whichever is better.

        It is refined once: as a free homography where it has inliers enough, else in the model that the solver assumes.
        The choice of the model refines the best of them again.
        """
        wide = 3.0 * self.options.threshold
        free = HomographyPairModel()
        if self.solver.model == free:
            return self._refined(start, data, rows, free, wide)
        enough = start.inliers.sum(axis=1) >= _FREE_REFINEMENT
        for chosen, model in ((enough, free), (~enough, self.solver.model)):
            part = np.flatnonzero(chosen)
            if len(part):
                start.put(part, self._refined(start.take(part), data.take(part), rows[part], model, wide))
        return start

    def _refined(
        self, start: Hypotheses, data: Measurements, rows: IntArray, model: PairModel, scale: float
    ) -> Hypotheses:
        """The start or its refinement, whichever is better."""
        problems = PairProblems(model, data, np.full(len(data), scale), None, self.solver.fixed_distortion)
        tilts = None if self.tilts is None else self.tilts[rows]
        at = problems.start(start.homography, start.distortion, tilts)
        refined, _ = descend(problems, at, _LOCAL_STEPS, loose=True)
        judged = Hypotheses.judged(
            problems.homography(refined), refined[:, 0], data, self.options.threshold, self.index
        )
        result = start.take(np.arange(len(data)))
        better = judged.cost < start.cost
        result.put(better, judged.take(better))
        return result


def _subset(data: Measurements) -> Measurements:
    """At most ``_QUICK_SCORE`` matches of each pair, spread over its list, to compare many hypotheses by."""
    if data.present.shape[1] <= _QUICK_SCORE:
        return data
    number = np.arange(_QUICK_SCORE)
    jitter = number * _GOLDEN % 1.0
    index = ((number + jitter) * (data.count[:, None] / _QUICK_SCORE)).astype(np.intp)
    few = data.count <= _QUICK_SCORE
    index[few] = number
    return data.at(index)
