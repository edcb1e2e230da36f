"""What travels between the stages and the workers, a frame: ``python -m tests.benchmarks.wire [--frames N]``.

The tasks of a mosaic and their results are pickled as they are for worker processes and for Dask; beside them is
what lies in the store, and the processor time of each stage, which docs/scale.md reckons with.
"""

import argparse
import pickle
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

from rdstitch import FeatureOptions, StitchOptions, mosaic
from tests.floor_drives import floor_drive


class CountingExecutor(Executor):
    """One thread that runs tasks as another process would get them, and counts their bytes and seconds."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1)
        self.tasks: dict[str, int] = defaultdict(int)
        self.sent: dict[str, int] = defaultdict(int)
        self.returned: dict[str, int] = defaultdict(int)
        self.seconds: dict[str, float] = defaultdict(float)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """See :meth:`concurrent.futures.Executor.submit`."""
        return self._thread.submit(self._run, pickle.dumps((fn, args, kwargs)))

    def _run(self, task: bytes) -> Any:
        fn, args, kwargs = pickle.loads(task)
        begun = time.thread_time()
        answer = pickle.dumps(fn(*args, **kwargs))
        self.seconds[fn.__name__] += time.thread_time() - begun
        self.tasks[fn.__name__] += 1
        self.sent[fn.__name__] += len(task)
        self.returned[fn.__name__] += len(answer)
        return pickle.loads(answer)


def main() -> None:
    """Print bytes and processor time of a frame, by stage."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=100)
    frames = parser.parse_args().frames
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "frames").mkdir()
        files = floor_drive("parking", frames, seed=7, size=(480, 360)).write(folder / "frames")
        executor = CountingExecutor()
        options = StitchOptions(features=FeatureOptions(), cache=folder / "store", workers=1, force=True)
        begun = time.process_time()
        with patch("rdstitch.options.open_executor", lambda *_, **__: executor):
            registration = mosaic(files, folder / "out.tif", options).registration
        rest = time.process_time() - begun - sum(executor.seconds.values())
        print(f"{frames} frames of 480 x 360 pixels, {len(registration.pairs)} pairs; of a frame:")
        print(f"{'':24s}{'tasks':>7s}{'kB there':>10s}{'kB back':>9s}{'ms':>7s}")
        for stage, count in executor.tasks.items():
            there, back = (amount[stage] / frames / 1e3 for amount in (executor.sent, executor.returned))
            milliseconds = 1e3 * executor.seconds[stage] / frames
            print(f"{stage:24s}{count / frames:7.2f}{there:10.2f}{back:9.2f}{milliseconds:7.1f}")
        print(f"{'not in tasks':48s}{1e3 * rest / frames:9.1f}")
        for part in sorted(path for path in (folder / "store").iterdir() if path.is_dir()):
            stored = [path.stat().st_size for path in part.rglob("*") if path.is_file()]
            print(f"store, {part.name:17s}{len(stored) / frames:7.2f}{sum(stored) / frames / 1e3:10.1f} kB")


if __name__ == "__main__":
    main()
