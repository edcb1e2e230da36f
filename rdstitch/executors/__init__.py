"""Where the tasks of a run are computed: threads, worker processes or a Dask cluster, behind one interface.

Stages take a :class:`concurrent.futures.Executor` and use nothing but its ``submit``. Their tasks are functions of this
package with small arguments and results; what is large lies in the cache of the run.
"""

import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

from rdstitch.executors.dask_cluster import LOCAL, DaskExecutor
from rdstitch.executors.processes import ProcessExecutor
from rdstitch.system.ahead import in_order_ahead

__all__ = ["LOCAL", "DaskExecutor", "ProcessExecutor", "batches", "in_order", "open_executor"]

_PROCESSES_FROM = 24
"""Images from which on it pays to start worker processes: each takes a second to begin with, and an image half a one.
Threads share the interpreter, which matching and estimation keep busy: two gain a quarter or less."""

_MAX_PENDING = 256  # tasks that have been submitted and whose results were not taken: enough for that many workers


def open_executor(workers: int, images: int, *, scheduler: str | None = None, store: Path | None = None) -> Executor:
    """The executor for a set of so many images, to be used in a ``with`` block; its workers must see the store."""
    if scheduler is not None:
        return DaskExecutor(scheduler, workers, store)
    if workers > 1 and images >= _PROCESSES_FROM and sys.executable:
        return ProcessExecutor(workers)
    return ThreadPoolExecutor(workers)


Item = TypeVar("Item")


def batches(items: Sequence[Item], most: int, fewest: int = 1) -> Iterator[Sequence[Item]]:
    """The items in parts of at most ``most``, ``fewest`` parts at least, so that a few keep several workers busy."""
    size = max(min(most, -(-len(items) // fewest)), 1)
    return (items[start : start + size] for start in range(0, len(items), size))


Task = TypeVar("Task")
Result = TypeVar("Result")


def in_order(executor: Executor, function: Callable[[Task], Result], tasks: Iterable[Task]) -> Generator[Result]:
    """The result of each task, in their order; tasks are taken as they are needed."""
    return in_order_ahead(executor, function, tasks, _MAX_PENDING)
