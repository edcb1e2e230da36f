"""The four-point solver by each constraint of planar motion on its own: which gives the best λ under noise?"""

from examples.paper.common.contenders import Contender
from rdstitch.arrays import FloatArray
from rdstitch.solvers import Solutions, four_point
from rdstitch.solvers.batch import IndexArray, solve_in_blocks
from rdstitch.solvers.four_point import QuarticEquation, SexticEquation
from rdstitch.solvers.homography import Quadrangles
from rdstitch.solvers.plane import lens_range
from rdstitch.solvers.roots import real_roots

_RANGE = (-1.5, 0.5)
_EQUATIONS = {QuarticEquation: 18, SexticEquation: 16}  # with their degrees in λ


def by_constraint() -> list[Contender]:
    """Four points with the invariant quartic, the sextic, and both."""
    return [
        Contender("4 points, invariant quartic", 4, lambda a, b, _: one_constraint(QuarticEquation, a, b)),
        Contender("4 points, sextic", 4, lambda a, b, _: one_constraint(SexticEquation, a, b)),
        Contender("4 points, both", 4, lambda a, b, _: four_point(a, b)),
    ]


def one_constraint(equation: type[QuarticEquation] | type[SexticEquation], x1: FloatArray, x2: FloatArray) -> Solutions:
    """:func:`rdstitch.solvers.four_point` with the roots of a single constraint."""

    def solve(points: FloatArray, _: IndexArray) -> Solutions:
        quadrangles = Quadrangles.of(points)
        index, distortion = real_roots(equation.of(quadrangles), _EQUATIONS[equation], *lens_range(points, _RANGE))
        h, possible = quadrangles.take(index).homography(distortion)
        return Solutions(index[possible], h[possible], distortion[possible])

    return solve_in_blocks(solve, x1, x2, 4)
