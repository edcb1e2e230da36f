"""Worker processes: what they run comes back in order; they end with their parent, and one that dies is replaced."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from rdstitch.errors import ArgumentError, InputError, LimitError
from rdstitch.executors import ProcessExecutor, in_order, open_executor, processes
from rdstitch.features import FeatureOptions
from rdstitch.inputs.source import read_sources
from rdstitch.io.write import write_image
from rdstitch.pipeline.registration.detect_features import detect_batch
from rdstitch.system.cache import Cache
from tests.unit.executors import tasks


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    if not Path("/proc").exists():
        return True
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:  # it has ended meanwhile
        return False


def _wait_until_gone(processes: list[int], seconds: float = 10.0) -> None:
    until = time.monotonic() + seconds
    while any(map(_alive, processes)):
        assert time.monotonic() < until, processes
        time.sleep(0.02)


def test_results_come_in_the_order_of_the_tasks_from_other_processes() -> None:
    with ProcessExecutor(2) as executor:
        assert list(in_order(executor, tasks.square, range(200))) == [k * k for k in range(200)]
        own = set(in_order(executor, tasks.process_number, [0.2] * 4))
    assert len(own) == 2
    assert os.getpid() not in own
    _wait_until_gone(list(own))


def test_workers_have_one_thread_and_may_print() -> None:
    with ProcessExecutor(1) as executor:
        assert executor.submit(tasks.thread_settings).result() == ("1", 1)
        assert executor.submit(tasks.chatter).result() == 7


def test_what_a_task_raises_is_raised_with_its_type() -> None:
    with ProcessExecutor(1) as executor:
        for kind in (InputError, ArgumentError, OSError, EOFError):
            with pytest.raises(kind, match="in a task"):
                executor.submit(tasks.fail, kind).result()
        with pytest.raises(RuntimeError, match="cannot travel"):
            executor.submit(tasks.fail_strangely).result()
        assert executor.submit(tasks.square, 3).result() == 9


def test_what_cannot_be_loaded_costs_its_task_only() -> None:
    with ProcessExecutor(1) as executor:
        with pytest.raises(AttributeError, match="cannot be loaded"):
            executor.submit(tasks.content_of, tasks.OnlyIn(os.getpid())).result(10.0)
        assert executor.submit(tasks.square, 3).result(10.0) == 9
        with pytest.raises(AttributeError, match="cannot be loaded"):
            executor.submit(tasks.only_here).result(10.0)
        assert executor.submit(tasks.square, 4).result(10.0) == 16


def test_a_shutdown_that_does_not_wait_lets_tasks_end() -> None:
    executor = ProcessExecutor(1)
    running, waiting = executor.submit(tasks.process_number, 0.3), executor.submit(tasks.square, 3)
    executor.shutdown(wait=False)
    assert waiting.result(10.0) == 9
    _wait_until_gone([running.result()])


def test_a_worker_that_dies_costs_its_task_only(tmp_path: Path) -> None:
    with ProcessExecutor(2) as executor:
        done = list(in_order(executor, tasks.die_once, [tmp_path / f"{k}" if k == 3 else None for k in range(8)]))
    assert done == [0] * 3 + [1] + [0] * 4
    with ProcessExecutor(1) as executor:
        with pytest.raises(LimitError, match="worker process was ended"):
            executor.submit(tasks.die, signal.SIGKILL).result()
        assert executor.submit(tasks.square, 3).result() == 9


def test_a_worker_whose_pipes_another_thread_has_closed_is_no_failure_of_the_task(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with ProcessExecutor(1) as executor:
        assert executor.submit(tasks.square, 2).result() == 4
        ended, start = executor._workers[0], ProcessExecutor._worker
        processes._end(ended)
        given = iter([ended])
        monkeypatch.setattr(ProcessExecutor, "_worker", lambda self: next(given, None) or start(self))
        assert executor.submit(tasks.square, 3).result() == 9


def test_an_exception_ends_the_workers_in_the_middle_of_their_tasks() -> None:
    def interrupted() -> None:
        with ProcessExecutor(2) as executor:
            workers.extend(in_order(executor, tasks.process_number, [0.2] * 4))
            executor.submit(time.sleep, 60)
            executor.submit(time.sleep, 60)
            time.sleep(0.1)
            raise KeyboardInterrupt

    workers: list[int] = []
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.monotonic() - begun < 20
    _wait_until_gone(workers)


def test_workers_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    program = """
        import time
        from rdstitch.executors import ProcessExecutor
        from tests.unit.executors import tasks
        executor = ProcessExecutor(1)
        print(executor.submit(tasks.process_number, 0).result(), flush=True)
        executor.submit(time.sleep, 60)
        time.sleep(60)
    """
    parent = subprocess.Popen([sys.executable, "-c", textwrap.dedent(program)], stdout=subprocess.PIPE)
    worker = int(parent.stdout.readline())
    assert _alive(worker)
    parent.kill()
    parent.communicate()
    _wait_until_gone([worker])


def test_a_script_is_not_run_again_by_its_workers(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "from rdstitch.executors import ProcessExecutor\n"
        "from tests.unit.executors import tasks\n"
        "print('once')\n"
        "with ProcessExecutor(2) as executor:\n"
        "    print(executor.submit(tasks.square, 5).result())\n",
        encoding="utf-8",
    )
    root = Path(__file__).resolve().parents[3]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(root), *sys.path])}
    done = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "once\n25\n"
    assert done.stderr == ""


def test_few_tasks_are_under_way() -> None:
    numbers = iter(range(1000))
    with ThreadPoolExecutor(1) as executor:
        assert next(in_order(executor, tasks.square, numbers)) == 0
    assert next(numbers) < 500


def test_after_a_failure_the_rest_is_cancelled(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as executor, pytest.raises(ZeroDivisionError):
        list(in_order(executor, tasks.leave_trace, [tmp_path / "first", None, *(tmp_path / f"{k}" for k in range(40))]))
    assert len(list(tmp_path.iterdir())) < 10


@pytest.mark.parametrize(
    ("workers", "images", "kind"),
    [(1, 1000, ThreadPoolExecutor), (4, 12, ThreadPoolExecutor), (2, 40, ProcessExecutor), (2, 1000, ProcessExecutor)],
)
def test_few_images_are_not_worth_starting_processes(workers: int, images: int, kind: type[Executor]) -> None:
    with open_executor(workers, images) as executor:
        assert isinstance(executor, kind)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="pages of another system and C library")
def test_workers_keep_the_memory_of_one_image_for_the_next(tmp_path: Path) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (600, 800), dtype=np.uint8)
    write_image(tmp_path / "noise.png", cv2.GaussianBlur(pixels, (0, 0), 2.0))
    sources = read_sources([tmp_path / "noise.png"], camera=None, focal=None, distortion=None, skip_bad=False)[0]
    with ProcessExecutor(1) as executor:
        pages = []
        for _ in range(5):
            executor.submit(detect_batch, sources, options=FeatureOptions(), store=Cache.for_this_run()).result()
            pages.append(executor.submit(tasks.pages).result())
    assert pages[-1] - pages[-2] < 3_000, np.diff(pages)
