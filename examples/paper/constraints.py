"""The four-point solver by each constraint of planar motion on its own: which gives the best λ under noise?"""

from functools import cache
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from examples.paper.contenders import Contender
from rdstitch.camera import FloatArray
from rdstitch.planar_motion import PlanarMotion
from rdstitch.solvers import Solutions, four_point, four_point_dlt
from rdstitch.solvers.batch import solve_in_blocks
from rdstitch.solvers.four_point import QuarticEquation, SexticEquation
from rdstitch.solvers.homography import homography_through
from rdstitch.solvers.plane import lens_range
from rdstitch.solvers.roots import real_roots

QUARTICS = 11
"""Independent quartics in the entries of H that vanish for planar motion."""

_RANGE = (-1.5, 0.5)
_EQUATIONS = {QuarticEquation: 18, SexticEquation: 16}  # with their degrees in λ
_MONOMIALS = np.array(list(combinations_with_replacement(range(9), 4)))
_GRID = 160
_REFINEMENT = 1e-3


def by_constraint() -> list[Contender]:
    """Four points with the invariant quartic, the sextic, both, and all quartics at once."""
    return [
        Contender("4 points, invariant quartic", 4, lambda a, b, _: one_constraint(QuarticEquation, a, b)),
        Contender("4 points, sextic", 4, lambda a, b, _: one_constraint(SexticEquation, a, b)),
        Contender("4 points, both", 4, lambda a, b, _: four_point(a, b)),
        Contender("4 points, all quartics", 4, lambda a, b, _: all_quartics(a, b)),
    ]


def one_constraint(equation: type[QuarticEquation] | type[SexticEquation], x1: FloatArray, x2: FloatArray) -> Solutions:
    """:func:`rdstitch.solvers.four_point` with the roots of a single constraint."""

    def solve(a: FloatArray, b: FloatArray, _: NDArray[np.intp]) -> Solutions:
        index, distortion = real_roots(equation.from_points(a, b), _EQUATIONS[equation], *lens_range(a, b, _RANGE))
        h, possible = homography_through(a[..., index], b[..., index], distortion)
        return Solutions(index[possible], h[possible], distortion[possible])

    return solve_in_blocks(solve, x1, x2, 4)


def all_quartics(x1: FloatArray, x2: FloatArray) -> Solutions:
    """Minima over λ of the sum of squares of all quartics, which under noise have no root in common."""
    grid = np.linspace(*_RANGE, _GRID)
    cost = np.stack([_cost(x1, x2, np.full(len(x1), lam))[0] for lam in grid])
    inner = cost[1:-1]
    place, sample = np.nonzero((inner < cost[:-2]) & (inner <= cost[2:]))
    order = np.argsort(sample, kind="stable")
    sample, lam = sample[order], grid[place[order] + 1]
    a, b = x1[sample], x2[sample]
    for step in (grid[1] - grid[0], _REFINEMENT, _REFINEMENT):
        left, middle, right = (_cost(a, b, lam + offset)[0] for offset in (-step, 0.0, step))
        with np.errstate(invalid="ignore"):
            move = 0.5 * step * (left - right) / (left - 2.0 * middle + right)
        lam = lam + np.clip(np.nan_to_num(move), -step, step)
    final, h = _cost(a, b, lam)
    found = np.isfinite(final)
    return Solutions(sample[found], h[found], lam[found])


def _cost(x1: FloatArray, x2: FloatArray, distortion: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sum of squares of the quartics (B,), inf where there is no homography, and H (B, 3, 3) of unit norm."""
    solved = four_point_dlt(x1, x2, distortion)
    cost, h = np.full(len(x1), np.inf), np.zeros((len(x1), 3, 3))
    h[solved.sample] = solved.homography / np.linalg.norm(solved.homography, axis=(1, 2), keepdims=True)
    cost[solved.sample] = ((quartic_monomials(h[solved.sample]) @ planar_quartics()) ** 2).sum(axis=1)
    return cost, h


@cache
def planar_quartics() -> FloatArray:
    """Orthonormal coefficients (495, 11) of the quartics that vanish for planar motion.

    They are the null space of the degree-4 monomials of many homographies of planar motion.
    """
    rng = np.random.default_rng(0)
    tilts, moves = rng.uniform(-1.0, 1.0, (700, 2)), rng.uniform(-1.0, 1.0, (700, 2))
    motions = [
        PlanarMotion((psi, theta), yaw, (tx, ty)).homography()
        for (psi, theta), yaw, (tx, ty) in zip(tilts, rng.uniform(-np.pi, np.pi, 700), moves, strict=True)
    ]
    h = np.array(motions)
    monomials = quartic_monomials(h / np.linalg.norm(h, axis=(1, 2), keepdims=True))
    coefficients: FloatArray = np.linalg.svd(monomials, full_matrices=False)[2][-QUARTICS:].T
    return coefficients


def quartic_monomials(homography: FloatArray) -> FloatArray:
    """All products of four entries of H, shape (B, 495)."""
    entries = homography.reshape(-1, 9)
    product: FloatArray = entries[:, _MONOMIALS].prod(axis=2)
    return product
