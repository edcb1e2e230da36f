"""Work on images that workers do."""

from concurrent.futures import Executor, ThreadPoolExecutor

import pytest

from rdstitch.executors import ProcessExecutor
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.pipeline.run_on_sources import blocks_on


@pytest.mark.parametrize(
    ("executor", "blocks"), [(ThreadPoolExecutor(8), False), (ProcessExecutor(2), False), (ProcessExecutor(4), True)]
)
def test_few_processes_leave_compositing_to_threads(executor: Executor, *, blocks: bool) -> None:
    with executor:
        assert (blocks_on(executor, [], InputGuard(), None) is not None) == blocks
