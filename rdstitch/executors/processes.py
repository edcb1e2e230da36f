"""Worker processes that start clean: nothing of the program that uses rdstitch is run or copied in them.

:class:`concurrent.futures.ProcessPoolExecutor` would run the main module of the program again in every worker, or copy
a process with its threads; its workers survive a killed parent; and one that dies takes all tasks with it.
"""

import os
import pickle
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from queue import SimpleQueue
from types import TracebackType
from typing import IO, Any, ParamSpec, TypeVar

from rdstitch.errors import LimitError
from rdstitch.system.process_memory import take_over_memory

Given = ParamSpec("Given")
Result = TypeVar("Result")

_PROGRAM = "from rdstitch.executors.processes import work; work()"
_ONE_THREAD = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"),
    "OPENCV_FOR_THREADS_NUM",
)
_ATTEMPTS = 2  # at a task whose worker died
_LENGTH_BYTES = 8  # of the field that holds the length of a pickle


class ProcessExecutor(Executor):
    """Each thread of a pool hands its tasks to a process of its own, over pipes.

    Leaving its ``with`` block by an exception, Ctrl-C for one, ends the workers at once; and they end by themselves
    when this process is killed.
    """

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self._threads, self._own = ThreadPoolExecutor(workers), threading.local()
        self._workers: list[subprocess.Popen[bytes]] = []
        self._lock, self._stopped = threading.Lock(), False

    def submit(self, fn: Callable[Given, Result], /, *args: Given.args, **kwargs: Given.kwargs) -> Future[Result]:
        """See :meth:`concurrent.futures.Executor.submit`; function and arguments are pickled."""
        return self._threads.submit(self._run, pickle.dumps((fn, args, kwargs), pickle.HIGHEST_PROTOCOL))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._threads.shutdown(wait, cancel_futures=cancel_futures)
        if wait:
            self._stop()
        else:  # the workers end when their tasks have
            threading.Thread(target=self.shutdown).start()

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
            assert worker.stdin is not None
            assert worker.stdout is not None
            try:
                _send(worker.stdin, task)
                answer = _receive(worker.stdout)
            except (EOFError, OSError, ValueError):  # ended from outside, or by _stop
                _end(worker)
                continue
            succeeded, result = pickle.loads(answer)
            if not succeeded:
                raise result
            return result
        raise LimitError(
            "a worker process was ended from outside, twice at the same task (no memory left?); fewer workers (-j) "
            "need less memory"
        )

    def _worker(self) -> "subprocess.Popen[bytes]":
        """The process of this thread, started when it is needed."""
        worker: subprocess.Popen[bytes] | None = getattr(self._own, "worker", None)
        if worker is None or worker.poll() is not None:
            paths = os.pathsep.join(path for path in sys.path if path)
            with self._lock:
                if self._stopped:
                    raise CancelledError
                worker = self._own.worker = subprocess.Popen(
                    [sys.executable, "-P", "-W", "ignore", "-c", _PROGRAM],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    env={**os.environ, **dict.fromkeys(_ONE_THREAD, "1"), "PYTHONPATH": paths},
                    # A session of its own: Ctrl-C on the terminal is for the parent alone.
                    start_new_session=True,
                )
                self._workers.append(worker)
        return worker

    def _stop(self) -> None:
        with self._lock:
            self._stopped = True
            for worker in self._workers:
                _end(worker)


def _end(worker: "subprocess.Popen[bytes]") -> None:
    """End a process now."""
    worker.kill()
    worker.wait()
    for pipe in (worker.stdin, worker.stdout):
        # What was not written yet cannot be any more.
        with suppress(OSError):
            if pipe is not None:
                pipe.close()


def work() -> None:
    """Run tasks, in a worker: they come in by standard input and results go out by standard output, pickled.

    Until the parent closes the pipe, or is gone; then it ends at once, in the middle of a task if need be.
    """
    results = os.fdopen(os.dup(1), "wb")
    # What a library prints must not come among the results.
    os.dup2(2, 1)
    take_over_memory()
    tasks: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_queue_tasks, args=(os.fdopen(os.dup(0), "rb"), tasks), daemon=True).start()
    while True:
        _send(results, _answer(tasks.get()))


def _queue_tasks(stream: IO[bytes], tasks: "SimpleQueue[bytes]") -> None:
    while True:
        try:
            tasks.put(_receive(stream))
        except EOFError:
            os._exit(0)


def _send(stream: IO[bytes], pickled: bytes) -> None:
    """Write a pickle after its length: one that cannot be loaded leaves nothing behind for the next."""
    stream.write(len(pickled).to_bytes(_LENGTH_BYTES, "big"))
    stream.write(pickled)
    stream.flush()


def _receive(stream: IO[bytes]) -> bytes:
    """Read a pickle after its length; EOFError where the other side is gone."""
    length = int.from_bytes(_exactly(stream, _LENGTH_BYTES), "big")
    return _exactly(stream, length)


def _exactly(stream: IO[bytes], count: int) -> bytes:
    content = stream.read(count)
    if len(content) < count:
        raise EOFError
    return content


def _answer(task: bytes) -> bytes:
    """Run a task; whether it succeeded, and what it gave or raised, pickled."""
    try:
        function, positional, named = pickle.loads(task)
        return pickle.dumps((True, function(*positional, **named)), pickle.HIGHEST_PROTOCOL)
    except BaseException as error:  # noqa: BLE001 - it is the task's failure, and goes where the task came from
        text = "".join(traceback.format_exception(error))
        error.add_note(f"in a worker process:\n{text}")
        try:
            answer = pickle.dumps((False, error))
            pickle.loads(answer)
        except Exception:  # noqa: BLE001 - an exception may hold anything
            return pickle.dumps((False, RuntimeError(text)))
        return answer
