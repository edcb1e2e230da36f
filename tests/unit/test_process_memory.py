"""How freed memory goes back or is kept, and how threads share what they take for a while."""

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Thread

import pytest

from rdstitch import process_memory
from rdstitch.process_memory import scratch_memory

_LARGE_AND_SMALL = """
from os import sysconf
import numpy as np
from rdstitch.process_memory import return_freed_memory

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * sysconf("SC_PAGE_SIZE")

return_freed_memory()
# After this the C library would put all up to this size onto its heap.
np.ones(28_000_000, dtype=np.uint8)
before, arrays, between = resident(), [], []
for _ in range(8):
    arrays.append(np.ones(12_000_000, dtype=np.uint8))
    between.append(np.ones(3000, dtype=np.uint8))
arrays.clear()
print(resident() - before)
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the system does not say what a process holds")
def test_large_arrays_go_back_though_small_ones_were_made_between_them() -> None:
    # In a process of its own: an array that fits into a hole that others have left on the heap stays there.
    done = subprocess.run([sys.executable, "-c", _LARGE_AND_SMALL], capture_output=True, text=True, check=True)
    assert int(done.stdout) == pytest.approx(0, abs=10e6)


_AGAIN_AND_AGAIN = """
import resource, sys
import numpy as np
from rdstitch.process_memory import return_freed_memory, reuse_freed_memory
return_freed_memory()
if len(sys.argv) > 1:
    reuse_freed_memory()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(50):
    arrays = [np.ones(1_000_000, dtype=np.uint8) for _ in range(40 if len(sys.argv) > 1 else 1)]
    del arrays
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="pages of another system and C library")
def test_arrays_that_are_made_again_and_again_do_not_come_from_the_system_each_time() -> None:
    done = subprocess.run([sys.executable, "-c", _AGAIN_AND_AGAIN], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 2_000  # pages; one array has 245


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="pages of another system and C library")
def test_what_each_image_takes_is_reused_for_the_next() -> None:
    command = [sys.executable, "-c", _AGAIN_AND_AGAIN, "many"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(done.stdout) < 20_000  # pages; the arrays of a round have 9,800


def test_threads_share_the_memory_that_they_give_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_memory, "_SCRATCH", 100)
    held: list[int] = []
    most: list[int] = []

    def work(size: int) -> None:
        with scratch_memory(size):
            held.append(size)
            most.append(sum(held))
            time.sleep(0.01)
            held.remove(size)

    with ThreadPoolExecutor(4) as threads:
        # One that is larger than all that there is goes on alone.
        list(threads.map(work, [60, 40, 150, 30, 30, 30, 30]))
    assert max(most) == 150
    assert sorted(most)[-2] <= 100


def test_what_fails_gives_its_memory_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_memory, "_SCRATCH", 100)
    with pytest.raises(ZeroDivisionError), scratch_memory(100):
        _ = 1 // 0
    done = []

    def work() -> None:
        with scratch_memory(100):
            done.append(True)

    thread = Thread(target=work, daemon=True)
    thread.start()
    thread.join(5)
    assert done
