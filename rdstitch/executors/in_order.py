"""Results of tasks, in the order of the tasks, with few of them under way."""

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Executor, Future
from typing import TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")

_MAX_PENDING = 256  # tasks that have been submitted and whose results were not taken: enough for that many workers


def in_order(executor: Executor, function: Callable[[Task], Result], tasks: Iterable[Task]) -> Generator[Result]:
    """The result of each task, in their order; tasks are taken as they are needed.

    Parameters
    ----------
    executor : concurrent.futures.Executor
    function : callable
        Of one task.
    tasks : iterable

    Raises
    ------
    Exception
        What the first task that fails raises; those not yet begun are then cancelled.
    """
    under_way: deque[Future[Result]] = deque()
    try:
        for task in tasks:
            under_way.append(executor.submit(function, task))
            if len(under_way) >= _MAX_PENDING:
                yield under_way.popleft().result()
        while under_way:
            yield under_way.popleft().result()
    finally:
        for future in under_way:
            future.cancel()
