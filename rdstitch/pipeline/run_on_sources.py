"""Work on images that workers do, wherever they are, and what they notice of the files meanwhile."""

from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Executor
from contextlib import closing
from typing import TypeVar

from rdstitch.executors import in_order
from rdstitch.inputs.input_guard import GuardState, InputGuard
from rdstitch.inputs.source import Source

Result = TypeVar("Result")
SourceTask = tuple[Callable[[Sequence[Source]], Result], Sequence[Source]]
"""A function and the images that it works on."""


def run_on_sources(executor: Executor, tasks: Iterable[SourceTask[Result]], guard: InputGuard) -> Generator[Result]:
    """The result of each task, in their order; ``guard`` learns of all changes and damage of the files."""
    with closing(in_order(executor, _result_and_state, tasks)) as done:
        for result, state in done:
            guard.merge(state)
            yield result


def _result_and_state(task: SourceTask[Result]) -> tuple[Result, GuardState]:
    """What a worker sends back; its images, which were sent together, have one guard."""
    function, sources = task
    result = function(sources)
    return result, sources[0].guard.state_of([source.path for source in sources]) if sources else ({}, {})
