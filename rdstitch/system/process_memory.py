"""Memory of this process: how what earlier stages have freed goes back to the system, or is kept for the next."""

import ctypes
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Condition

_MMAP_THRESHOLD, _TRIM_THRESHOLD, _ARENA_MAX = -3, -1, -8  # of mallopt
_LARGE = 8 * 2**20  # bytes: more than any array of a tile, which are made again and again; less than an image
_SCRATCH = 280 * 10**6  # bytes that the threads of this process may take at once for what they give back soon


_mallopt: list[Callable[[int, int], object]] = []  # of the C library, in a process of our own


def take_over_memory() -> None:
    """Choose what the C library (glibc) keeps of what is freed, in a process that is ours: a command, or a worker.

    Its choice cannot be given back, so that a host's process keeps its own. Large arrays go back as soon as they are
    freed; otherwise the library would soon put them onto its heaps, where small ones between them keep what is freed.
    What is free at the end of a heap goes back once it is twice as much, as the library has it while it chooses itself:
    its first threshold would have every array of a few hundred kilobytes come from the system anew, page by page. What
    one stage's threads have freed is wanted by the next one's: heaps of their own would keep it.
    """
    with suppress(AttributeError, OSError, TypeError):
        _mallopt[:] = [ctypes.CDLL(None).mallopt]
    _choose(_ARENA_MAX, 1)
    _choose(_MMAP_THRESHOLD, _LARGE)
    _choose(_TRIM_THRESHOLD, 2 * _LARGE)


def return_freed_memory() -> None:
    """Return what is freed to the system; in a process of our own from now on too.

    What the threads of one stage have freed is of little use to those of the next, and would count twice.
    """
    _choose(_TRIM_THRESHOLD, 2 * _LARGE)
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def reuse_freed_memory() -> None:
    """Keep what is freed, in a process of our own, until :func:`return_freed_memory` is called next.

    For a stage that takes as much for one image after the other as :func:`scratch_memory` allows, such as the
    pyramids of SIFT: the system would clear every page of it anew.
    """
    _choose(_TRIM_THRESHOLD, _SCRATCH)


def _choose(parameter: int, value: int) -> None:
    for mallopt in _mallopt:
        mallopt(parameter, value)


def peak_memory() -> float:
    """Most memory that this process has held, MB (10⁶ bytes); on Linux since :func:`forget_peak_memory`.

    ``ru_maxrss``, for other systems, is never less than what the parent held when it started this process.
    """
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    try:
        import resource
    except ImportError:  # Windows
        return 0.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e6


def forget_peak_memory() -> None:
    """Begin the peak anew with what is held now, where the system can (proc(5))."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


_scratch_changed, _scratch_taken = Condition(), [0]


@contextmanager
def scratch_memory(size: int) -> Iterator[None]:
    """Wait until there is room for so many bytes that a thread takes for a while; one thread alone always has it.

    Blocks of it must not be nested: two threads would wait for each other.
    """
    with _scratch_changed:
        _scratch_changed.wait_for(lambda: _scratch_taken[0] == 0 or _scratch_taken[0] + size <= _SCRATCH)
        _scratch_taken[0] += size
    try:
        yield
    finally:
        with _scratch_changed:
            _scratch_taken[0] -= size
            _scratch_changed.notify_all()
