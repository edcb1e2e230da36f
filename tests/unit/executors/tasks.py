"""Tasks that workers can import."""

import os
import resource
import signal
import time
from pathlib import Path
from typing import Any

import cv2


def square(number: int) -> int:
    return number * number


def process_number(seconds: float) -> int:
    time.sleep(seconds)
    return os.getpid()


def thread_settings() -> tuple[str, int]:
    return os.environ["OPENBLAS_NUM_THREADS"], cv2.getNumThreads()


def chatter() -> int:
    os.write(1, b"a library prints\n" * 100)
    print("and so does Python")  # noqa: T201
    return 7


def fail(kind: type[Exception]) -> None:
    raise kind("in a task")


class _Strange(Exception):  # noqa: N818
    def __init__(self, one: int, two: int) -> None:
        super().__init__("cannot travel")


def fail_strangely() -> None:
    raise _Strange(1, 2)


def only_in(process: int, content: bytes) -> bytes:
    if os.getpid() != process:
        raise AttributeError("cannot be loaded here")
    return content


class OnlyIn:
    """What one process can load and no other."""

    def __init__(self, process: int) -> None:
        self.process = process

    def __reduce__(self) -> tuple[Any, ...]:
        return only_in, (self.process, bytes(300_000))


def content_of(loaded: OnlyIn) -> int:
    return loaded.process


def only_here() -> OnlyIn:
    return OnlyIn(os.getpid())


def die(number: int) -> None:
    os.kill(os.getpid(), number)


def die_once(trace: Path | None) -> int:
    """Die at the first attempt; the second finds the trace of the first."""
    if trace is None:
        return 0
    if not trace.exists():
        trace.touch()
        die(signal.SIGKILL)
    return 1


def leave_trace(path: Path | None) -> None:
    if path is None:
        raise ZeroDivisionError
    path.touch()
    time.sleep(0.02)


def pages() -> int:
    """That the process was given so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
