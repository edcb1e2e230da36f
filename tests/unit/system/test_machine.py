"""The machine: processors, memory, OpenCV's state, and what is imported when."""

import ctypes
import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

import rdstitch
from rdstitch.system import machine, process_memory
from rdstitch.system.machine import available_memory, processor_count
from rdstitch.system.process_memory import scratch_memory
from tests.cli.running import flight

FREE = {"proc/meminfo": "MemTotal: 16000 kB\nMemAvailable:    8000 kB\n"}
VERSION_2 = {
    "proc/self/cgroup": "0::/pod/box\n",
    "sys/fs/cgroup/pod/memory.max": "5000000\n",
    "sys/fs/cgroup/pod/memory.current": "4000000\n",
    "sys/fs/cgroup/pod/memory.stat": "anon 1500000\ninactive_file 2500000\n",
    "sys/fs/cgroup/pod/cpu.max": "150000 100000\n",
    "sys/fs/cgroup/pod/box/memory.max": "max\n",
    "sys/fs/cgroup/pod/box/cpu.max": "max 100000\n",
}
IN_A_CONTAINER = {
    "proc/self/cgroup": "0::/../../host/path\n",
    "sys/fs/cgroup/memory.max": "3000000\n",
    "sys/fs/cgroup/memory.current": "1000000\n",
    "sys/fs/cgroup/memory.stat": "inactive_file 0\n",
    "sys/fs/cgroup/cpu.max": "100000 100000\n",
}
VERSION_1 = {
    "proc/self/cgroup": "4:memory:/box\n1:cpu,cpuacct:/box\n0::/\n",
    "sys/fs/cgroup/memory/box/memory.limit_in_bytes": "2000000\n",
    "sys/fs/cgroup/memory/box/memory.usage_in_bytes": "500000\n",
    "sys/fs/cgroup/memory/box/memory.stat": "cache 100000\ntotal_inactive_file 100000\n",
    "sys/fs/cgroup/memory/memory.limit_in_bytes": "9223372036854771712\n",
    "sys/fs/cgroup/memory/memory.usage_in_bytes": "500000\n",
    "sys/fs/cgroup/cpu/box/cpu.cfs_quota_us": "200000\n",
    "sys/fs/cgroup/cpu/box/cpu.cfs_period_us": "100000\n",
    "sys/fs/cgroup/cpu/cpu.cfs_quota_us": "-1\n",
    "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000\n",
}


@pytest.mark.parametrize(
    ("files", "memory", "processors"),
    [
        (FREE, 8_192_000, 8),
        (FREE | VERSION_2, 3_500_000, 2),
        (FREE | IN_A_CONTAINER, 2_000_000, 1),
        (FREE | VERSION_1, 1_600_000, 2),
        (FREE | {"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/memory.max": "damaged"}, 8_192_000, 8),
    ],
    ids=["unlimited", "version 2", "container", "version 1", "damaged"],
)
def test_the_smallest_limit_holds(
    files: dict[str, str], memory: int, processors: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(machine, "_SYSTEM", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    assert available_memory() == memory
    assert processor_count() == processors


def test_affinity_limits_processors(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(machine, "_SYSTEM", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {3}, raising=False)
    assert processor_count() == 1
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 5)
    assert processor_count() == 5


def test_where_the_system_says_nothing_there_is_a_guess(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "_SYSTEM", tmp_path)
    assert available_memory() > 10**8


_LARGE_AND_SMALL = """
from os import sysconf
import numpy as np
from rdstitch.system.process_memory import return_freed_memory, take_over_memory

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * sysconf("SC_PAGE_SIZE")

take_over_memory()
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
from rdstitch.system.process_memory import return_freed_memory, reuse_freed_memory, take_over_memory
take_over_memory()
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
@pytest.mark.parametrize(("how", "pages"), [([], 2_000), (["many"], 20_000)])  # one array has 245, a round 9,800
def test_arrays_that_are_made_again_and_again_do_not_come_from_the_system_each_time(how: list[str], pages: int) -> None:
    command = [sys.executable, "-c", _AGAIN_AND_AGAIN, *how]
    assert int(subprocess.run(command, capture_output=True, text=True, check=True).stdout) < pages


def test_the_c_library_of_a_host_keeps_its_own_choices(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[str] = []

    class Library:
        def __getattr__(self, name: str) -> Callable[..., None]:
            return lambda *_: called.append(name)

    loaded = ctypes.CDLL
    monkeypatch.setattr(ctypes, "CDLL", lambda name: Library() if name is None else loaded(name))
    scene = np.random.default_rng(0).integers(0, 255, (60, 200), dtype=np.uint8).repeat(4, 0).repeat(2, 1)
    rdstitch.pano([scene[:, :280], scene[:, 100:]], options=rdstitch.StitchOptions(distortion=0.0, force=True))
    assert set(called) == {"malloc_trim"}


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


_UP_TO_THE_FIRST_IMAGE = """
import sys
from rdstitch.inputs import source
from rdstitch_cli.main import run

class Reached(BaseException):
    pass

def first(*_, **__):
    raise Reached

source.read_image = first
try:
    run(sys.argv[1:])
except Reached:
    pass
print(*sorted(sys.modules))
"""
_NOT_YET = {"scipy", "tifffile", "tqdm", "matplotlib", "email", "rdstitch.pipeline.doctor"}
_NOT_YET |= {f"rdstitch.{room}" for room in ("report", "synthetic", "tracking", "camera_files", "stage")}


@pytest.mark.parametrize("command", ["pano", "mosaic"])
def test_up_to_the_first_image_no_more_is_imported_than_it_takes(command: str, tmp_path: Path) -> None:
    frames = flight(2, 1).write(tmp_path)
    arguments = [command, *map(str, frames), "-o", str(tmp_path / "out.png"), "-j", "1"]
    done = subprocess.run(
        [sys.executable, "-c", _UP_TO_THE_FIRST_IMAGE, *arguments], capture_output=True, text=True, check=True
    )
    imported = done.stdout.split()
    assert "rdstitch.pipeline.recipes" in imported
    assert not {".".join(name.split(".")[:k]) for name in imported for k in (1, 2, 3)} & _NOT_YET
