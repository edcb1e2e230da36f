"""Worker processes that start clean: nothing of the program that uses rdstitch is run or copied in them.

:class:`concurrent.futures.ProcessPoolExecutor` would run the main module of the program again in every worker, or copy
a process with its threads; its workers survive a killed parent; and one that dies takes all tasks with it.
"""

import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any, ParamSpec, TypeVar

from rdstitch.errors import LimitError

Given = ParamSpec("Given")
Result = TypeVar("Result")

_PROGRAM = "from rdstitch.executors.worker import main; main()"
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_ATTEMPTS = 2  # at a task whose worker died


class ProcessExecutor(Executor):
    """Each thread of a pool hands its tasks to a process of its own, over pipes.

    Leaving its ``with`` block by an exception, Ctrl-C for one, ends the workers at once; and they end by themselves
    when this process is killed.
    """

    def __init__(self, workers: int) -> None:
        self._threads = ThreadPoolExecutor(workers)
        self._own = threading.local()
        self._workers: list[_Worker] = []
        self._lock = threading.Lock()
        self._stopped = False

    def submit(self, fn: Callable[Given, Result], /, *args: Given.args, **kwargs: Given.kwargs) -> Future[Result]:
        """See :meth:`concurrent.futures.Executor.submit`; function and arguments are pickled."""
        return self._threads.submit(self._run, pickle.dumps((fn, args, kwargs), pickle.HIGHEST_PROTOCOL))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._threads.shutdown(wait, cancel_futures=cancel_futures)
        self._stop()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """End the workers; in the middle of their tasks after an exception."""
        if error is not None:
            self._stop()
        self.shutdown(cancel_futures=error is not None)

    def _run(self, task: bytes) -> Any:
        for _ in range(_ATTEMPTS):
            worker = self._worker()
            try:
                succeeded, result = worker.run(task)
            except (EOFError, OSError, pickle.UnpicklingError):
                worker.stop()
                continue
            if not succeeded:
                raise result
            return result
        raise LimitError(
            "a worker process was ended from outside, twice at the same task (no memory left?); fewer workers (-j) "
            "need less memory"
        )

    def _worker(self) -> "_Worker":
        """The process of this thread, started when it is needed."""
        worker: _Worker | None = getattr(self._own, "worker", None)
        if worker is None or not worker.alive:
            with self._lock:
                if self._stopped:
                    raise CancelledError
                worker = self._own.worker = _Worker()
                self._workers.append(worker)
        return worker

    def _stop(self) -> None:
        with self._lock:
            self._stopped = True
            for worker in self._workers:
                worker.stop()


class _Worker:
    """A process that runs one task after the other."""

    def __init__(self) -> None:
        environment = {**os.environ, **dict.fromkeys(_ONE_THREAD, "1")}
        environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
        # A session of its own: Ctrl-C on the terminal is for the parent alone.
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-W", "ignore", "-c", _PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            start_new_session=True,
        )

    @property
    def alive(self) -> bool:
        """Whether it can take a task."""
        return self._process.poll() is None

    def run(self, task: bytes) -> tuple[bool, Any]:
        """Whether a task succeeded, and what it gave or raised; EOFError or OSError when the process ends meanwhile."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(task)
        self._process.stdin.flush()
        answer: tuple[bool, Any] = pickle.load(self._process.stdout)
        return answer

    def stop(self) -> None:
        """End the process now."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                try:
                    pipe.close()
                except OSError:  # what was not written yet cannot be any more
                    continue
