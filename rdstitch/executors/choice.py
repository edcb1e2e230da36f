"""Which executor a run gets."""

import sys
from concurrent.futures import Executor, ThreadPoolExecutor

from rdstitch.executors.processes import ProcessExecutor

_MANY = 60
"""Pictures from which on it pays to start worker processes, each of which takes a second to begin with. Threads share
the interpreter, which matching and estimation keep busy."""


def open_executor(workers: int, pictures: int) -> Executor:
    """The executor for a set of so many pictures, to be used in a ``with`` block.

    Parameters
    ----------
    workers : int
        Tasks at the same time.
    pictures : int
    """
    if workers > 1 and pictures >= _MANY and sys.executable:
        return ProcessExecutor(workers)
    return ThreadPoolExecutor(workers)
