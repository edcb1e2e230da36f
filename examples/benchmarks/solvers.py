"""The minimal solvers, measured: ``python -m examples.benchmarks.solvers [--seed N]``.

Accuracy on 20,000 noise-free instances a solver; time on batches of 4,096 and on single samples. Times are printed with
their ratio to the linear algebra that elimination templates of the same problems cost, measured in turns with the
solvers in the same run; it is processor time, of all cores together.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import scipy.linalg

from examples.benchmarks.driver import run
from rdstitch import solvers
from rdstitch.arrays import FloatArray
from rdstitch.solvers import Solutions
from tests.instances import Instances, PlanarInstances, general_instances, planar_instances, rotation_instances

INSTANCES = 20_000
BATCH = 4096
ROUNDS = 7

Solve = Callable[[FloatArray, FloatArray], Solutions]


@dataclass(frozen=True)
class Case:
    """A solver with instances of its problem; ``tilt`` and ``distortion`` are what it is told of them."""

    solver: Callable[..., Solutions]
    instances: Instances
    floor: str
    tilt: FloatArray | None = None
    distortion: FloatArray | None = None

    def solve(self, start: int, stop: int) -> Solutions:
        """Run it on some of the instances."""
        known: dict[str, Any] = {}
        if self.tilt is not None:
            known["tilt"] = self.tilt if self.tilt.ndim == 1 else self.tilt[start:stop]
        if self.distortion is not None:
            known["distortion"] = self.distortion[start:stop]
        return self.solver(self.instances.x1[start:stop], self.instances.x2[start:stop], **known)


def cases(seed: int, count: int, known_tilt: float) -> list[Case]:
    """Every solver, with its instances: λ in [-0.7, 0], unknown tilts up to 0.3 radians.

    Where the tilt is known it is up to ``known_tilt``, and the solver is told one for each sample; with 0, one for all,
    as for the images of one camera.
    """

    def told(points: int, **options: Any) -> tuple[PlanarInstances, FloatArray]:
        instances = planar_instances(count, points, seed=seed, max_tilt=known_tilt, **options)
        return instances, np.stack([instances.tilt, instances.tilt2], axis=1) if known_tilt else np.zeros(2)

    two, tilt_two = told(2, separate_tilts=True)
    scaled_two, tilt_scaled_two = told(2, height=(0.75, 1.3))
    scaled, tilt_scaled = told(3, height=(0.75, 1.3))
    three, four = (planar_instances(count, points, seed=seed) for points in (3, 4))
    free_four, five = (general_instances(count, points, seed=seed) for points in (4, 5))
    turned_two, turned_three = (rotation_instances(count, points, seed=seed) for points in (2, 3))
    return [
        Case(solvers.two_point, two, "small", tilt_two),
        Case(solvers.three_point, three, "small"),
        Case(solvers.three_point_similarity, scaled, "small", tilt_scaled),
        Case(solvers.four_point, four, "large"),
        Case(solvers.five_point, five, "small"),
        Case(solvers.five_point_qep, five, "small"),
        Case(solvers.two_point_rigid, two, "small", tilt_two, two.distortion),
        Case(solvers.two_point_similarity, scaled_two, "small", tilt_scaled_two, scaled_two.distortion),
        Case(solvers.four_point_dlt, free_four, "small", distortion=free_four.distortion),
        Case(solvers.rotation_two_point, turned_two, "small"),
        Case(solvers.rotation_three_point, turned_three, "small"),
        Case(solvers.rotation_two_point_focal, turned_two, "small", distortion=turned_two.distortion),
    ]


def template_floors() -> dict[str, tuple[Callable[[], object], int]]:
    """Linear algebra of elimination templates: a function, and how many instances it stands for.

    "large" is one LU of 177 x 177 with 18 right-hand sides and the eigenvalues and vectors of 18 x 18; "small" is a
    solution of 18 x 18 with 6 right-hand sides and the eigenvalues of 6 x 6. Batched NumPy or SciPy one by one,
    whichever is faster here.
    """
    rng = np.random.default_rng(0)
    large, large_right = rng.normal(size=(16, 177, 177)), rng.normal(size=(16, 177, 18))
    small, small_right = rng.normal(size=(BATCH, 18, 18)), rng.normal(size=(BATCH, 18, 6))
    large_action, small_action = rng.normal(size=(16, 18, 18)), rng.normal(size=(BATCH, 6, 6))

    def batched_large() -> None:
        np.linalg.solve(large, large_right)
        np.linalg.eig(large_action)

    def single_large() -> None:
        for matrix, right, action in zip(large, large_right, large_action, strict=True):
            factors = scipy.linalg.lu_factor(matrix, check_finite=False)
            scipy.linalg.lu_solve(factors, right, check_finite=False)
            scipy.linalg.eig(action, check_finite=False)

    def batched_small() -> None:
        np.linalg.solve(small, small_right)
        np.linalg.eigvals(small_action)

    return {
        "large": (min((batched_large, single_large), key=lambda work: best_time([work])[0]), len(large)),
        "small": (batched_small, len(small)),
    }


def best_time(works: Sequence[Callable[[], object]], rounds: int = ROUNDS) -> list[float]:
    """Shortest processor time of each, seconds; measured in turns, so that a busy machine slows all of them alike."""
    times = np.empty((rounds, len(works)))
    for row in times:
        for i, work in enumerate(works):
            start = time.process_time()
            work()
            row[i] = time.process_time() - start
    return [float(t) for t in times.min(axis=0)]


def print_accuracy(name: str, instances: Instances, solutions: Solutions) -> None:
    """One row: solutions a sample, samples with one, samples with the true one, errors."""
    error, h_error = instances.best_errors(solutions)
    solved = len(np.unique(solutions.sample)) / len(instances)
    print(
        f"{name:24s}{len(solutions) / len(instances):11.2f}{100 * solved:10.2f}{100 * np.mean(error < 1e-3):10.3f}"
        f"{np.median(error):12.1e}{np.median(h_error):12.1e}"
    )


def print_homlib(instances: Instances) -> None:
    """The solvers of homlib for the five-point problem, called one sample at a time as they are made for."""
    try:
        import homlib
    except ImportError:
        print("\nhomlib is not installed (pip install homlib): its solvers are left out")
        return
    peers: dict[str, Callable[[FloatArray, FloatArray], list[Any]]] = {
        "Fitzgibbon 2001": homlib.estimate_fitzgibbon_cvpr_2001_two_sided_equal,
        "Kukelova 2015": partial(_call, homlib.estimate_kukelova_cvpr_2015_two_sided, True),
        "Wadenback 2026": partial(_call, homlib.estimate_wadenback_3dv_2026_two_sided_equal, False),
    }
    pairs = [(a.T, b.T) for a, b in zip(instances.x1[:1000], instances.x2[:1000], strict=True)]
    works = [partial(_all, peer, pairs) for peer in peers.values()]
    print(f"\n{'homlib (C++), five points':28s}{'solutions':>11s}{'found %':>10s}{'median |Δλ|':>13s}{'µs':>9s}")
    for (name, peer), seconds in zip(peers.items(), best_time(works, 3), strict=True):
        results = _all(peer, pairs)
        errors = [
            min((abs(pose.distortion_parameter - truth) for pose in poses), default=np.inf)
            for poses, truth in zip(results, instances.distortion[:1000], strict=True)
        ]
        found, mean = np.mean(np.array(errors) < 1e-3), np.mean([len(poses) for poses in results])
        print(f"{name:28s}{mean:11.2f}{100 * found:10.2f}{np.median(errors):13.1e}{1e6 * seconds / 1000:9.2f}")


def _call(function: Callable[..., list[Any]], option: bool, a: FloatArray, b: FloatArray) -> list[Any]:
    return function(a, b, option)


def _all(peer: Callable[..., list[Any]], pairs: list[tuple[FloatArray, FloatArray]]) -> list[list[Any]]:
    return [peer(a, b) for a, b in pairs]


def main(*, seed: int = 20_000) -> None:
    """Print the tables."""
    print(f"{INSTANCES:,} noise-free instances, λ in [-0.7, 0], tilt up to 0.3 rad, any yaw")
    print(f"{'':24s}{'solutions':>11s}{'solved %':>10s}{'found %':>10s}{'median |Δλ|':>12s}{'median |ΔH|':>12s}")
    for case in cases(seed, INSTANCES, known_tilt=0.3):
        print_accuracy(case.solver.__name__, case.instances, case.solve(0, INSTANCES))

    everything = cases(seed, BATCH, known_tilt=0.0)
    floors = template_floors()
    works = [work for work, _ in floors.values()]
    works += [partial(case.solve, 0, BATCH) for case in everything]
    works += [partial(case.solve, 0, 1) for case in everything]
    seconds = best_time(works)
    floor_times = {name: seconds[i] / count for i, (name, (_, count)) in enumerate(floors.items())}
    batched = seconds[len(floors) :][: len(everything)]
    single = seconds[len(floors) + len(everything) :]
    print("\ntime of the linear algebra of elimination templates, µs a sample")
    for name, label in (("large", "177 x 177 and 18 x 18"), ("small", "18 x 18 and 6 x 6")):
        print(f"  {label:24s}{1e6 * floor_times[name]:9.2f}")
    print(f"\n{'time, µs a sample':24s}{f'batch {BATCH}':>12s}{'single':>10s}   batched, times faster than templates")
    for case, many, one in zip(everything, batched, single, strict=True):
        ratio = floor_times[case.floor] / (many / BATCH)
        print(f"{case.solver.__name__:24s}{1e6 * many / BATCH:12.2f}{1e6 * one:10.0f}{ratio:11.1f} ({case.floor})")
    print_homlib(everything[4].instances)


if __name__ == "__main__":
    run(main)
