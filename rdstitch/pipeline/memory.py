"""Memory between the stages of a recipe."""

import ctypes
from contextlib import suppress


def release_free_heap() -> None:
    """Give memory that earlier stages have freed back to the system, where the C library would keep it (glibc).

    What the threads of one stage have freed is of little use to those of the next, and would count twice.
    """
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
