"""Processors and memory that a process may use, as the system and its control groups say."""

import os
from pathlib import Path

import pytest

from rdstitch import machine
from rdstitch.machine import available_memory, processor_count

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
