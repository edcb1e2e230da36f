"""Threads that libraries below Python start of their own, kept from it while a recipe runs several."""

import ctypes
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache

from rdstitch.system.opencv_state import one_opencv_thread

_EXTENSION = "numpy._core._multiarray_umath"  # what NumPy's matrix products are in
# OpenBLAS's functions to read and set the number of its threads, with and without the marks of NumPy's wheels.
_NAMES = [f"{mark}openblas_{{}}_num_threads{suffix}" for mark in ("scipy_", "") for suffix in ("64_", "")]
_lock = threading.Lock()
_held: list[int] = []  # the number of threads before each of the blocks that hold it


@contextmanager
def one_native_thread() -> Iterator[None]:
    """Keep OpenCV, and OpenBLAS below NumPy, to one thread each, around a whole recipe.

    Images and pairs are worked on side by side; threads within each matrix product would be in the way of these, and
    wait for each other busily: of 80 small images they doubled the processor time.
    """
    with one_opencv_thread(), _one_blas_thread():
        yield


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    """The number may change at any time; the last of several blocks to end gives back what was before all of them."""
    functions = _openblas()
    if functions is None:
        yield
        return
    read, write = functions
    with _lock:
        _held.append(read())
        write(1)
    try:
        yield
    finally:
        with _lock:
            before = _held.pop()
            if not _held:
                write(before)


@cache
def _openblas() -> tuple[Callable[[], int], Callable[[int], object]] | None:
    """Its functions to read and to set the number of threads; None where NumPy has another BLAS, or Windows hides it.

    Elsewhere an extension module gives the functions of the libraries that it is linked with.
    """
    with suppress(KeyError, OSError, TypeError):
        library = ctypes.CDLL(sys.modules[_EXTENSION].__file__)
        for name in _NAMES:
            with suppress(AttributeError):
                return getattr(library, name.format("get")), getattr(library, name.format("set"))
    return None
