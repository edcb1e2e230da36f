"""Runtime (paper §5.1): processor time per instance of every solver, batched and one at a time, beside homlib's."""

import time
from collections.abc import Callable

import numpy as np

from examples.paper.common.contenders import HOMLIB, Contender, absent, known_tilt, optional_module, own_unknown_tilt
from examples.paper.common.report import Report, Settings, Table
from examples.worlds.instances import PlanarInstances, planar_instances

_SINGLES = 40
_REPETITIONS = 5

Row = tuple[str, float | None, float, float]


def run(settings: Settings) -> Report:
    """Microseconds per instance, and how they relate to the fastest solver of homlib."""
    count = settings.count(100, 2000, 20_000)
    instances = planar_instances(count, 5, seed=1, noise=0.5 / 400.0)
    own = [_measure(contender, instances) for contender in known_tilt() + own_unknown_tilt()]
    peers = _measure_homlib(instances)
    unit = min((single for _, _, single, _ in peers), default=None)
    rows = []
    for name, batched, single, solutions in own + peers:
        ratio = None if unit is None else (single if batched is None else batched) / unit
        rows.append((name, batched, single, ratio, solutions))
    table = Table(
        f"Runtime: processor time per instance, {count} instances with 0.5 px of noise, best of {_REPETITIONS} runs",
        ("solver", "batched, µs", "one call each, µs", "ratio to homlib's fastest", "solutions"),
        tuple(rows),
    )
    return Report((table,), notes=absent("homlib"))


def _measure(contender: Contender, instances: PlanarInstances) -> Row:
    """Name, time per instance in a batch and alone, µs, and solutions per instance."""
    solutions = contender(instances)
    few = [_one(instances, index) for index in range(min(_SINGLES, len(instances)))]
    batched = _best_time(lambda: contender(instances)) / len(instances)
    single = _best_time(lambda: [contender(one) for one in few]) / len(few)
    return contender.name, 1e6 * batched, 1e6 * single, len(solutions) / len(instances)


def _measure_homlib(instances: PlanarInstances) -> list[Row]:
    """The same of homlib's solvers, which have no batches; only the calls themselves are timed."""
    homlib = optional_module("homlib")
    if homlib is None:
        return []
    columns = [np.ascontiguousarray(np.swapaxes(x, 1, 2)) for x in (instances.x1, instances.x2)]
    pairs = list(zip(*columns, strict=True))
    rows: list[Row] = []
    for name, function, arguments in HOMLIB:
        estimate = getattr(homlib, function)

        def solve_all(estimate: Callable[..., list[object]] = estimate, rest: tuple[bool, ...] = arguments) -> int:
            return sum(len(estimate(a, b, *rest)) for a, b in pairs)

        rows.append((name, None, 1e6 * _best_time(solve_all) / len(pairs), solve_all() / len(pairs)))
    return rows


def _one(instances: PlanarInstances, index: int) -> PlanarInstances:
    """A batch of one."""
    return PlanarInstances(**{name: value[index : index + 1] for name, value in vars(instances).items()})


def _best_time(work: Callable[[], object]) -> float:
    """Shortest of a few runs, seconds of processor time: what others on the machine take away is not ours."""
    times = []
    for _ in range(_REPETITIONS):
        begun = time.process_time()
        work()
        times.append(time.process_time() - begun)
    return min(times)
