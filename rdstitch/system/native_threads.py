"""Threads that libraries below Python start of their own, kept from it while a recipe runs several."""

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import cache

from rdstitch.system.opencv_state import HeldState, one_opencv_thread

_EXTENSION = "numpy._core._multiarray_umath"  # what NumPy's matrix products are in
# OpenBLAS's functions to read and set the number of its threads, with and without the marks of NumPy's wheels.
_NAMES = [f"{mark}openblas_{{}}_num_threads{suffix}" for mark in ("scipy_", "") for suffix in ("64_", "")]


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
