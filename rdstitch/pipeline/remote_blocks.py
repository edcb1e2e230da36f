"""Blocks of an output, computed by the workers that registered its images."""

from collections.abc import Generator, Iterable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial
from pathlib import Path

from rdstitch.compositing.tiles import Block, BlockRunner, OutputStrip
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.inputs.source import Source
from rdstitch.pipeline.run_on_sources import run_on_sources
from rdstitch.system.cache import Cache, Stored


def blocks_on(
    executor: Executor, sources: Sequence[Source], guard: InputGuard, folder: Path | None
) -> BlockRunner | None:
    """What computes blocks of an output on the workers of an executor; None for threads, which need no blocks.

    ``folder`` is what all machines see by the same name, for the strips; None where there is one machine.
    """
    if isinstance(executor, ThreadPoolExecutor):
        return None

    def run(blocks: Iterable[Block]) -> Generator[list[Stored[OutputStrip]]]:
        store = Cache.for_this_run(folder)
        tasks = ((partial(compose_block, block, store), [sources[k] for k in block.images]) for block in blocks)
        yield from run_on_sources(executor, tasks, guard)

    return run


def compose_block(block: Block, store: Cache, _sources: Sequence[Source]) -> list[Stored[OutputStrip]]:
    """Compute a block, which reads these images, into a store."""
    return block.compute(store)
