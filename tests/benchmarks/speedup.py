"""What a second worker process is worth: ``python -m tests.benchmarks.speedup [--frames N] [--workers N]``.

Detection, first matching, and matching and estimation of pairs of a drone's survey (480 x 360 frames) run with one
worker process, then with several. Printed are the wall times and their ratio, which mean something on an idle machine
only; the processor time of the main process and of the tasks; and the ratio that follows from both for so many idle
cores: each task is begun by the first worker that is free, and the main process is never busy at the same time.
"""

import argparse
import heapq
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from dataclasses import astuple, dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rdstitch import StitchOptions
from rdstitch.cache import Cache
from rdstitch.executors import ProcessExecutor
from rdstitch.features import match
from rdstitch.inputs.source import Source, read_sources
from rdstitch.matching.candidate_pairs import first_pairs
from rdstitch.matching.two_view_rounds import Pairing
from rdstitch.pipeline.detect_features import detect_by_contrast
from rdstitch.pipeline.working_size import at_working_size
from rdstitch.progress import silent
from tests.benchmarks.scale import survey, write_frames


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """What a task gives, and the processor time that it took."""
    begun = time.process_time()
    return function(*arguments), time.process_time() - begun


@dataclass
class TimedExecutor(Executor):
    """Worker processes that say how long their tasks took, s of processor time."""

    processes: ProcessExecutor
    taken: dict[str, list[float]] = field(default_factory=dict)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """See :meth:`concurrent.futures.Executor.submit`."""
        answer: Future[Any] = Future()
        own = self.taken.setdefault(fn.__name__, [])
        position = len(own)
        own.append(0.0)

        def pass_on(done: Future[tuple[Any, float]]) -> None:
            if (error := done.exception()) is not None:
                answer.set_exception(error)
                return
            result, seconds = done.result()
            own[position] = seconds
            answer.set_result(result)

        self.processes.submit(partial(timed, fn, *args), **kwargs).add_done_callback(pass_on)
        return answer


def makespan(seconds: list[float], workers: int) -> float:
    """When the last of these tasks ends, each begun in turn by the first worker that is free."""
    free = [0.0] * workers
    for own in seconds:
        heapq.heapreplace(free, free[0] + own)
    return max(free)


@dataclass(frozen=True)
class Cost:
    """Seconds of one stage: wall; processor time of the main process, of its tasks, and of the last worker to end."""

    wall: float
    main: float
    tasks: float
    longest: float


@dataclass
class Run:
    """All stages with so many workers."""

    executor: TimedExecutor
    workers: int
    stages: dict[str, Cost] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure a stage."""
        self.executor.taken.clear()
        wall, main = time.monotonic(), time.process_time()
        yield
        wall, main = time.monotonic() - wall, time.process_time() - main
        kinds = self.executor.taken.values()
        longest = sum(makespan(seconds, self.workers) for seconds in kinds)
        self.stages[name] = Cost(wall, main, sum(map(sum, kinds)), longest)


def measure(sources: list[Source], workers: int) -> dict[str, Cost]:
    """The stages of a registration that are made of tasks."""
    options = StitchOptions(workers=workers).for_images(len(sources))
    with ProcessExecutor(workers) as processes:
        # Libraries are loaded before the clock starts: a run does that once.
        for ready in [processes.submit(time.sleep, 0.5) for _ in range(workers)]:
            ready.result()
        run, store = Run(TimedExecutor(processes), workers), Cache.for_this_run()
        with run.stage("detection"):
            found = detect_by_contrast(sources, options.features, run.executor, store, skip_bad=False, progress=silent)
        cameras = [at_working_size(source.camera, options.features.limits[1]) for source in sources]
        features = found.detected.features.at_sizes([camera.image_size for camera in cameras])
        candidates = first_pairs(features, options.seed)
        matcher = partial(match, ratio=options.ratio)
        pairing = Pairing(features, cameras, matcher, options.matching, silent, run.executor, store=store)
        with run.stage("first matching"):
            prescreened = pairing.prescreen_pairs(candidates)
        with run.stage("pairs"):
            pairing.estimate(prescreened, shared=prescreened)
    return run.stages


def main() -> None:
    """Print one line a stage, and one of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    with TemporaryDirectory() as name:
        write_frames(survey(given.frames), list(range(given.frames)), Path(name))
        files = sorted(Path(name).iterdir())
        sources, _ = read_sources(files, camera=None, focal=None, distortion=None, skip_bad=False)
        one, several = (measure(sources, workers) for workers in (1, given.workers))
    names = ("wall 1", f"wall {given.workers}", "ratio", "main", "tasks", f"{given.workers} idle")
    print(f"{given.frames} frames{'':9s}" + "".join(f"{name:>10s}" for name in names))
    for runs in (one, several):
        runs["all"] = Cost(*(sum(values) for values in zip(*map(astuple, runs.values()), strict=True)))
    for stage, alone in one.items():
        cost = several[stage]
        ideal = (cost.main + cost.tasks) / (cost.main + cost.longest)
        line = f"{stage:18s}{alone.wall:10.1f}{cost.wall:10.1f}{alone.wall / cost.wall:10.2f}"
        print(f"{line}{cost.main:10.2f}{cost.tasks:10.2f}{ideal:10.2f}")


if __name__ == "__main__":
    # Workers look for the tasks by the name of this module, not of the program.
    from tests.benchmarks.speedup import main as run_as_module

    run_as_module()
