"""Running tasks on images, and blocks of outputs, on workers, and collecting their notes on the files."""

from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TypeVar

from rdstitch.compositing.tiles import Block, BlockRunner, OutputStrip
from rdstitch.executors import ProcessExecutor, in_order
from rdstitch.inputs.input_guard import GuardState, InputGuard
from rdstitch.inputs.source import Source
from rdstitch.system.cache import Cache, Stored

# Worker processes from which on they compose, not threads: blocks read images twice and strips once more. Two processes
# take 26 s where threads take 23 (75 images of 12 megapixels); more threads would wait for the interpreter.
_COMPOSING_FROM = 4

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
    """The result and the notes of a worker; images that were sent together share a guard."""
    function, sources = task
    result = function(sources)
    return result, sources[0].guard.state_of([source.path for source in sources]) if sources else ({}, {})


def blocks_on(
    executor: Executor, sources: Sequence[Source], guard: InputGuard, folder: Path | None
) -> BlockRunner | None:
    """The runner of blocks of an output on workers, with strips in ``folder``; None where threads do."""
    few = isinstance(executor, ProcessExecutor) and executor.workers < _COMPOSING_FROM
    if few or isinstance(executor, ThreadPoolExecutor):
        return None

    def run(blocks: Iterable[Block]) -> Generator[list[Stored[OutputStrip]]]:
        store = Cache.for_this_run(folder)
        tasks = ((partial(compose_block, block, store), [sources[k] for k in block.images]) for block in blocks)
        yield from run_on_sources(executor, tasks, guard)

    return run


def compose_block(block: Block, store: Cache, _sources: Sequence[Source]) -> list[Stored[OutputStrip]]:
    """Compute a block, which reads these images, into a store."""
    return block.compute(store)
