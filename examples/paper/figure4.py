"""Fig. 4: errors against noise, tilt known, and what it costs when the known tilt is wrong."""

import numpy as np

from examples.paper.common.contenders import WITNESSES, Contender, absent, known_tilt, sweep, unknown_tilt
from examples.paper.common.report import Report, Settings
from examples.worlds.instances import PlanarInstances, planar_instances
from rdstitch import solvers
from rdstitch.arrays import FloatArray
from rdstitch.solvers import Solutions

_WRONG_BY = 1.0  # degrees


def run(settings: Settings) -> Report:
    """Median errors of λ and H of a levelled camera: two points beside the solvers that do not need to know."""
    count = settings.count(100, 500, 10_000)

    def draw(noise: float, level: int) -> PlanarInstances:
        return planar_instances(count, 5 + WITNESSES, seed=40 + level, noise=noise, max_tilt=0.0)

    wrong = Contender(f"2 points, tilt wrong by {_WRONG_BY:g}°", 2, _two_point_wrong_tilt)
    found = sweep([*known_tilt(), wrong, *unknown_tilt()], draw)
    return Report(found.tables("Fig. 4", f"no tilt, {count} instances a level"), found.draw, notes=absent("homlib"))


def _two_point_wrong_tilt(x1: FloatArray, x2: FloatArray, tilt: FloatArray) -> Solutions:
    off = tilt + np.radians(_WRONG_BY) * np.array([np.sqrt(0.5), -np.sqrt(0.5)])
    return solvers.two_point(x1, x2, np.repeat(off[:, None, :], 2, axis=1))
