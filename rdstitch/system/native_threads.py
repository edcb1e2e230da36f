"""State that OpenCV and OpenBLAS keep for the whole process: their threads, and what OpenCV logs.

It is changed for a while and left as it was found, whatever threads do.
"""

import ctypes
import selectors
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import thread
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from typing import Any

import cv2

_EXTENSION = "numpy._core._multiarray_umath"  # what NumPy's matrix products are in
# OpenBLAS's functions to read and set the number of its threads, with and without the marks of NumPy's wheels.
_NAMES = [f"{mark}openblas_{{}}_num_threads{suffix}" for mark in ("scipy_", "") for suffix in ("64_", "")]
_SILENT = 0  # the log level of that name
# OpenCV 4 has the same functions at its top level; its stubs know neither.
_logging: Any = getattr(cv2.utils, "logging", cv2)
# Functions that do nothing but wait: those of events, conditions and queues, of event loops, and of idle pools.
_WAITING = {threading.Condition.wait.__code__, selectors.DefaultSelector.select.__code__}
# That of idle pools has a private name; where it has another one, a pool that was begun meanwhile counts as busy.
_WAITING |= {worker.__code__ for worker in (getattr(thread, "_worker", None),) if worker is not None}


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Keep OpenCV from starting threads of its own while a recipe runs several: they would wait for each other.

    It is switched only where no other thread is there, which may be inside OpenCV: many of its functions divide by the
    number of its threads, and end the process if that changes meanwhile. So it is held around a whole recipe. It is put
    back where all other threads wait, such as a progress bar's or a client's that were started meanwhile.
    """
    # 0 rather than 1: a forked process would wait for ever for the end of threads that its parent alone has.
    before = cv2.getNumThreads()
    switched = before > 1 and threading.active_count() == 1
    if switched:
        cv2.setNumThreads(0)
    try:
        yield
    finally:
        if switched and _others_wait():
            cv2.setNumThreads(before)


def _others_wait() -> bool:
    """Whether every other thread waits for something in Python, and so is not inside OpenCV."""
    frames = sys._current_frames()
    others = [thread for thread in threading.enumerate() if thread is not threading.current_thread()]
    return all((frame := frames.get(thread.ident or 0)) and frame.f_code in _WAITING for thread in others)


class HeldState:
    """A number that belongs to the whole process, and is another one while any of several blocks lasts.

    The last block to end, which may be in another thread, gives back what was before all of them.
    """

    def __init__(self, read: Callable[[], int], write: Callable[[int], object], inside: int) -> None:
        self.read, self._write, self._inside = read, write, inside
        self._lock, self._blocks, self._before = threading.Lock(), 0, inside

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold it inside the block."""
        with self._lock:
            self._before = self._before if self._blocks else self.read()
            self._blocks += 1
            self._write(self._inside)
        try:
            yield
        finally:
            with self._lock:
                self._blocks -= 1
                if not self._blocks:
                    self._write(self._before)


silent_opencv = HeldState(_logging.getLogLevel, _logging.setLogLevel, _SILENT).held
"""Keeps OpenCV from logging what an exception or a return value says already."""


@contextmanager
def one_native_thread() -> Iterator[None]:
    """Keep OpenCV, and OpenBLAS below NumPy, to one thread each, around a whole recipe.

    Images and pairs are worked on side by side; threads within each matrix product would be in the way of these, and
    wait for each other busily: of 80 small images they doubled the processor time.
    """
    blas = _openblas()
    with one_opencv_thread(), nullcontext() if blas is None else blas.held():
        yield


@cache
def _openblas() -> HeldState | None:
    """The number of its threads; None where NumPy has another BLAS, or Windows hides it.

    Elsewhere an extension module gives the functions of the libraries that it is linked with.
    """
    with suppress(KeyError, OSError, TypeError):
        library = ctypes.CDLL(sys.modules[_EXTENSION].__file__)
        for name in _NAMES:
            with suppress(AttributeError):
                return HeldState(getattr(library, name.format("get")), getattr(library, name.format("set")), 1)
    return None
