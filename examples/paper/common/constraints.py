"""The four-point solver by each constraint of planar motion on its own: which gives the best λ under noise?"""

from functools import cache
from itertools import combinations_with_replacement

import numpy as np

from examples.paper.common.contenders import Contender
from rdstitch.arrays import FloatArray
from rdstitch.planar_motion import PlanarMotion
from rdstitch.solvers import Solutions, four_point
from rdstitch.solvers.batch import IndexArray, solve_in_blocks
from rdstitch.solvers.four_point import QuarticEquation, SexticEquation
from rdstitch.solvers.homography import Quadrangles
from rdstitch.solvers.orientation import oriented_samples
from rdstitch.solvers.plane import lens_range
from rdstitch.solvers.polynomials import chebyshev_from_values, chebyshev_nodes
from rdstitch.solvers.roots import real_roots

QUARTICS = 11
"""Independent quartics in the entries of H that vanish for planar motion."""

_RANGE = (-1.5, 0.5)
_EQUATIONS = {QuarticEquation: 18, SexticEquation: 16}  # with their degrees in λ
_DEGREE = 20  # of any quartic in the entries of H
_MONOMIALS = np.array(list(combinations_with_replacement(range(9), 4)))
_GRID = np.linspace(-1.0, 1.0, 160)
_REFINEMENT = 1e-3
_BLOCK = 256


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

    def solve(points: FloatArray, _: IndexArray) -> Solutions:
        quadrangles = Quadrangles.of(points)
        index, distortion = real_roots(equation.of(quadrangles), _EQUATIONS[equation], *lens_range(points, _RANGE))
        h, possible = quadrangles.take(index).homography(distortion)
        return Solutions(index[possible], h[possible], distortion[possible])

    return solve_in_blocks(solve, x1, x2, 4)


def all_quartics(x1: FloatArray, x2: FloatArray) -> Solutions:
    """Minima over λ of the sum of squares of all quartics, which under noise have no root in common.

    Before H is scaled to unit norm its entries, and so the quartics and the square of the norm, are polynomials in λ:
    their values at a few nodes give them on a grid. From there parabolas lead to the minima.
    """

    def solve(points: FloatArray, _: IndexArray) -> Solutions:
        quadrangles = Quadrangles.of(points)
        usable, low, high = oriented_samples(quadrangles.triangles, *lens_range(points, _RANGE))
        quadrangles, half = quadrangles.take(usable), 0.5 * (high - low)
        cost = _cost_on_grid(QuarticEquation.of(quadrangles), low + half, half)
        sample, place = np.nonzero(((cost[1:-1] < cost[:-2]) & (cost[1:-1] <= cost[2:])).T)
        distortion = low[sample] + half[sample] * (1.0 + _GRID[place + 1])
        quadrangles = quadrangles.take(sample)
        for step in (half[sample] * (_GRID[1] - _GRID[0]), _REFINEMENT, _REFINEMENT):
            left, middle, right = (_cost(quadrangles, distortion + offset) for offset in (-step, 0.0, step))
            move = np.nan_to_num(0.5 * (left - right) / (left - 2.0 * middle + right))
            distortion = distortion + step * np.clip(move, -1.0, 1.0)
        h, possible = quadrangles.homography(distortion)
        return Solutions(usable[sample[possible]], h[possible], distortion[possible])

    return solve_in_blocks(solve, x1, x2, 4, _BLOCK)


def _cost_on_grid(equation: QuarticEquation, middle: FloatArray, half: FloatArray) -> FloatArray:
    """Sum of squares of the quartics in H of unit norm, on a grid about the middle of an interval; (len(_GRID), b)."""
    h, _ = equation.homography(middle + chebyshev_nodes(_DEGREE)[:, None] * half)
    from_values = np.polynomial.chebyshev.chebvander(_GRID, _DEGREE) @ chebyshev_from_values(_DEGREE)
    entries = np.moveaxis(h.reshape(9, -1), 0, -1)
    quartics = (quartic_monomials(entries) @ planar_quartics()).reshape(_DEGREE + 1, -1)
    squares = ((from_values @ quartics) ** 2).reshape(len(_GRID), -1, QUARTICS).sum(axis=-1)
    norm2 = from_values @ (h * h).sum(axis=(0, 1))
    cost: FloatArray = squares / norm2**4
    return cost


def _cost(quadrangles: Quadrangles, distortion: FloatArray) -> FloatArray:
    """Sum of squares of the quartics (b,), inf where there is no homography."""
    h, possible = quadrangles.homography(distortion)
    cost = ((quartic_monomials(h) @ planar_quartics()) ** 2).sum(axis=1)
    return np.where(possible, cost, np.inf)


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
