"""Levenberg-Marquardt for many small problems in lockstep."""

from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol, Self, TypeVar

import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray, Rows

SHORT_STEP = 0.3  # standard deviations of all parameters together: a step that is not worth taking
LOOSE_STEP = 1.0  # the same where another descent goes on from there
FIRST_DAMPING = 1e-4  # fraction of the diagonal of the normal matrix with which a descent begins
MAX_DAMPING = 1e4  # the same beyond which it has got stuck
_MIN_DAMPING = 1e-9


@dataclass(eq=False)
class BatchedNormalEquations(Rows):
    """The loss of B problems at some parameters, and what a step from there takes."""

    cost: FloatArray  # (B,)
    information: FloatArray  # (B, P, P): weighted ``J'J``
    gradient: FloatArray  # (B, P): half the gradient of the cost
    squared: FloatArray  # (B, N): squared errors of the measurements; inf where there is none

    @property
    def unit(self) -> FloatArray:
        """What a step of one standard deviation gains, (B,)."""
        return self.cost

    @property
    def errors(self) -> FloatArray:
        """Errors of the measurements, (B, N); inf where there is none."""
        return np.sqrt(self.squared)

    def where(self, better: BoolArray, others: Self) -> Self:
        """The others where they are better."""
        if better.all():
            return others
        result = self.take(np.arange(len(better)))
        result.put(np.flatnonzero(better), others.take(better))
        return result


Equations = TypeVar("Equations", bound=BatchedNormalEquations)


class Problems(Protocol[Equations]):
    """B problems of least squares, as the descent sees them."""

    def take(self, rows: BoolArray | IntArray) -> Self:
        """Some of them."""
        ...

    def normal_equations(self, parameters: FloatArray) -> Equations:
        """Normal equations at parameters (B, K)."""
        ...

    def cost(self, before: Equations, after: Equations) -> FloatArray:
        """Losses (B,) of ``before``, as the errors are weighed in ``after``."""
        ...

    def retract(self, parameters: FloatArray, step: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Parameters after steps (B, P), and whether they are possible."""
        ...


def descend(
    problems: Problems[Equations], start: FloatArray, iterations: int, *, loose: bool = False
) -> tuple[FloatArray, Equations]:
    """Where at most so many steps lead to, parameters of shape (B, K), and the equations there.

    Damping falls tenfold or rises twentyfold, which suffices for a pair; :func:`damping_by_gain` is for many images.
    A problem that has converged takes no further part, so that each is solved as if it were alone. ``loose``: another
    descent goes on from there.
    """
    least_gain = (LOOSE_STEP if loose else SHORT_STEP) ** 2
    result, parameters = start.copy(), start
    current = equations = problems.normal_equations(start)
    damping, rows = np.full(len(start), FIRST_DAMPING), np.arange(len(start))
    for _ in range(iterations):
        step = _damped_step(current, damping)
        gain = -np.einsum("bp,bp->b", step, current.gradient)
        going = (gain > least_gain * current.unit) & (damping <= MAX_DAMPING)
        if not going.any():
            break
        if not going.all():
            result[rows[~going]] = parameters[~going]
            equations.put(rows[~going], current.take(~going))
            rows, step, parameters, damping = rows[going], step[going], parameters[going], damping[going]
            problems, current = problems.take(going), current.take(going)
        moved, possible = problems.retract(parameters, step)
        trial = problems.normal_equations(moved)
        better = possible & (trial.cost < problems.cost(current, trial))
        damping = np.where(better, np.maximum(damping / 10.0, _MIN_DAMPING), damping * 20.0)  # Marquardt (1963)
        if better.any():
            parameters, current = np.where(better[:, None], moved, parameters), current.where(better, trial)
    if len(rows) == len(start):
        return parameters, current
    result[rows] = parameters
    equations.put(rows, current)
    return result, equations


def damping_by_gain(damping: float, failures: int, gain: float) -> tuple[float, int]:
    """Damping of the next step, and how many steps have failed since one was taken (Nielsen 1999).

    Where the loss has a curved valley, as focal length, tilts and lens together have, tenfold changes go to and fro
    between steps that are too short and steps that fail.

    ``gain``: by how much the last step made the loss smaller, in units of what was predicted.
    """
    if gain > 0.0:
        return max(damping * max(1.0 / 3.0, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3), _MIN_DAMPING), 0
    return damping * 2.0 ** (failures + 1), failures + 1


def _damped_step(equations: BatchedNormalEquations, damping: FloatArray) -> FloatArray:
    """Steps (B, P); NaN where the equations are singular or not finite."""
    diagonal = np.einsum("bpp->bp", equations.information)
    largest = diagonal.max(axis=1, keepdims=True)
    solvable = np.isfinite(equations.information).all(axis=(1, 2)) & (largest[:, 0] > 0.0)
    damped = equations.information.copy()
    np.einsum("bpp->bp", damped)[...] += damping[:, None] * diagonal + 1e-12 * largest
    damped[~solvable] = np.eye(damped.shape[1])
    try:
        step = -np.linalg.solve(damped, equations.gradient[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:  # one of them is singular nevertheless
        step = np.full(equations.gradient.shape, np.nan)
        for row in range(len(step)):
            with suppress(np.linalg.LinAlgError):
                step[row] = -np.linalg.solve(damped[row], equations.gradient[row])
    step[~solvable] = np.nan
    return np.asarray(step, dtype=np.float64)
