"""Which executor a run gets."""

import sys
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path

from rdstitch.executors.dask_cluster import DaskExecutor
from rdstitch.executors.processes import ProcessExecutor

_PROCESSES_FROM = 60
"""Pictures from which on it pays to start worker processes: each takes a second to begin with, and a picture a third of
one, so that the start is at most a twentieth of the work. Threads share the interpreter, which matching and estimation
keep busy."""


def open_executor(workers: int, pictures: int, *, scheduler: str | None = None, store: Path | None = None) -> Executor:
    """The executor for a set of so many pictures, to be used in a ``with`` block.

    Parameters
    ----------
    workers : int
        Tasks at the same time on this machine.
    pictures : int
    scheduler : str, optional
        Address of a Dask scheduler, or "local"; see :class:`rdstitch.executors.dask_cluster.DaskExecutor`.
    store : Path, optional
        Folder of features and matches that the workers of that scheduler must see.
    """
    if scheduler is not None:
        return DaskExecutor(scheduler, workers, store)
    if workers > 1 and pictures >= _PROCESSES_FROM and sys.executable:
        return ProcessExecutor(workers)
    return ThreadPoolExecutor(workers)
