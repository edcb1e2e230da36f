"""Fig. 3: errors against noise, tilt unknown; which constraint of planar motion serves four points best."""

from examples.paper.common.constraints import by_constraint
from examples.paper.common.contenders import unknown_tilt
from examples.paper.common.noise import WITNESSES, sweep
from examples.paper.common.peers import absent
from examples.paper.common.report import Report
from examples.paper.common.settings import Settings
from tests.instances import PlanarInstances, planar_instances


def run(settings: Settings) -> Report:
    """Median errors of λ and H of solvers that are not told the tilt."""
    count = settings.count(100, 500, 10_000)

    def draw(noise: float, level: int) -> PlanarInstances:
        return planar_instances(count, 5 + WITNESSES, seed=30 + level, noise=noise)

    own = [contender for contender in unknown_tilt() if contender.name != "4 points"]
    found = sweep([own[0], *by_constraint(), *own[1:]], draw)
    about = f"tilt unknown, up to 0.3 rad, {count} instances a level"
    tables = (
        found.table(f"Fig. 3: median error of λ of the solution nearest to the truth, {about}", "nearest"),
        found.table(f"Fig. 3: median error of λ of the solution that {WITNESSES} more points choose", "chosen"),
        found.table("Fig. 3: median error of H of the solution nearest to the truth", "homography"),
    )
    return Report(tables, found.draw, notes=absent("homlib"))
