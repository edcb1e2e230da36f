"""Blocks of the output as tasks of an executor; their pictures are read by its workers."""

from collections.abc import Generator, Iterable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from rdstitch.cache import Cache
from rdstitch.compositing.blocks import Block, BlockRunner, BlockStrip
from rdstitch.executors import in_order
from rdstitch.inputs.input_guard import GuardNotes
from rdstitch.inputs.source import Source
from rdstitch.stored import Stored


@dataclass(frozen=True, eq=False)
class BlockTask:
    """A block, and what its worker must know beside.

    Attributes
    ----------
    block : Block
    sources : tuple of Source
        Its pictures.
    store : Cache
        Where its strips go.
    """

    block: Block
    sources: tuple[Source, ...]
    store: Cache


def blocks_on(executor: Executor, sources: Sequence[Source], folder: Path | None) -> BlockRunner | None:
    """What computes blocks of an output on the workers of an executor; None for threads, which need no blocks.

    Parameters
    ----------
    executor : concurrent.futures.Executor
    sources : sequence of Source
        The pictures of the composite.
    folder : Path or None
        What all machines see by the same name, for the strips; None where there is one machine.
    """
    if isinstance(executor, ThreadPoolExecutor):
        return None

    def run(blocks: Iterable[Block]) -> Generator[list[Stored[BlockStrip]]]:
        store = Cache.for_this_run(folder)
        tasks = (BlockTask(block, tuple(sources[k] for k in block.pictures), store) for block in blocks)
        with closing(in_order(executor, compose_block, tasks)) as done:
            for strips, notes in done:
                sources[0].guard.learn(notes)
                yield strips

    return run


def compose_block(task: BlockTask) -> tuple[list[Stored[BlockStrip]], GuardNotes]:
    """Compute a block; and what was noticed of its files."""
    strips = task.block.compute(task.store)
    if not task.sources:
        return strips, ({}, {}, {})
    # All have one guard, which travels with them.
    return strips, task.sources[0].guard.notes_on([source.path for source in task.sources])
