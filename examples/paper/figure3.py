"""Fig. 3: errors against noise, tilt unknown; which constraint of planar motion serves four points best."""

from examples.paper.common.contenders import WITNESSES, Contender, absent, sweep, unknown_tilt
from examples.paper.common.report import Report, Settings
from examples.worlds.instances import PlanarInstances, planar_instances
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


def run(settings: Settings) -> Report:
    """Median errors of λ and H of solvers that are not told the tilt."""
    count = settings.count(100, 500, 10_000)

    def draw(noise: float, level: int) -> PlanarInstances:
        return planar_instances(count, 5 + WITNESSES, seed=30 + level, noise=noise)

    own = [contender for contender in unknown_tilt() if contender.name != "4 points"]
    found = sweep([own[0], *by_constraint(), *own[1:]], draw)
    about = f"tilt unknown, up to 0.3 rad, {count} instances a level"
    return Report(found.tables("Fig. 3", about), found.draw, notes=absent("homlib"))
