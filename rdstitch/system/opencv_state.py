"""State that OpenCV keeps for the whole process, changed for a while and left as it was found, whatever threads do."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from threading import Lock
from typing import Any

import cv2

_SILENT = 0  # the log level of that name


class _SharedSetting:
    """A number of the process that blocks of code hold at another value: the last block to end restores it."""

    def __init__(self, read: Callable[[], int], write: Callable[[int], object], held: int) -> None:
        self._read, self._write, self._held = read, write, held
        self._lock, self._blocks, self._before = Lock(), 0, 0

    @contextmanager
    def hold(self) -> Iterator[None]:
        with self._lock:
            if self._blocks == 0:
                self._before = self._read()
                self._set(self._held)
            self._blocks += 1
        try:
            yield
        finally:
            with self._lock:
                self._blocks -= 1
                if self._blocks == 0:
                    self._set(self._before)

    def _set(self, value: int) -> None:
        if self._before != self._held:
            self._write(value)


def _opencv_threads() -> int:
    """0 for those of the caller alone: OpenCV says 1, but to set 1 would end its threads."""
    count = cv2.getNumThreads()
    return count if count > 1 else 0


# 0 rather than 1: a forked process would wait for ever for the end of threads that its parent alone has.
_threads = _SharedSetting(_opencv_threads, cv2.setNumThreads, 0)
# OpenCV 4 has the same functions at its top level; its stubs know neither.
_logging: Any = getattr(cv2.utils, "logging", cv2)
_log_level = _SharedSetting(_logging.getLogLevel, _logging.setLogLevel, _SILENT)


def one_opencv_thread() -> AbstractContextManager[None]:
    """Keep OpenCV from starting threads of its own while we run several: they would wait for each other."""
    return _threads.hold()


def silent_opencv() -> AbstractContextManager[None]:
    """Keep OpenCV from logging what an exception or a return value says already."""
    return _log_level.hold()
