"""What this process may use of the machine: processors and memory, by the smallest of all limits that hold for it."""

import os
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

_UNKNOWN = 2 * 2**30  # bytes, where the system does not say how much memory is available
_SYSTEM = Path("/")
# Limit, use and what of it are pages of files, of version 2 and 1 of control groups.
_MEMORY_FILES = (
    ("memory.max", "memory.current", "inactive_file"),
    ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)


def processor_count() -> int:
    """Processors that this process may run on: affinity and the quota of its control groups count (taskset, Docker)."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min([count, *_quotas(_SYSTEM)]))


def available_memory() -> int:
    """Bytes that this process can still take without swapping, within the limits of its control groups."""
    return min([_memory(_SYSTEM, "MemAvailable:"), *_group_memory(_SYSTEM)])


@cache
def memory_size() -> int:
    """Bytes that the machine has, or that the control groups of this process may take."""
    return min([_memory(_SYSTEM, "MemTotal:"), *_group_memory(_SYSTEM, in_use=False)])


def _memory(root: Path, what: str) -> int:
    """Memory of the whole system by what ``/proc/meminfo`` calls it, bytes."""
    for line in _text(root / "proc/meminfo").splitlines():
        if line.startswith(what):
            return int(line.split()[1]) * 1024
    with suppress(AttributeError, ValueError, OSError):
        # No system but Linux says what is available; half of what there is should be.
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // (1 if what == "MemTotal:" else 2)
    return _UNKNOWN


def _group_memory(root: Path, *, in_use: bool = True) -> Iterator[int]:
    """Bytes of each control group that limits memory, less those in use; pages of files that can go count as free."""
    for folder in _groups(root, "memory"):
        for limit, usage, reclaimable in _MEMORY_FILES:
            with suppress(ValueError):
                left = int(_text(folder / limit))
                if in_use:
                    stat = dict(line.split() for line in _text(folder / "memory.stat").splitlines())
                    left -= int(_text(folder / usage)) - int(stat.get(reclaimable, 0))
                yield max(0, left)


def _quotas(root: Path) -> Iterator[int]:
    """Processors that each control group has at the most, in the mean over time, rounded up."""
    for folder in _groups(root, "cpu"):
        quota = _text(folder / "cpu.max").split() or [
            _text(folder / f"cpu.cfs_{name}_us").strip() for name in ("quota", "period")
        ]
        with suppress(ValueError):
            time, period = map(int, quota)
            if time > 0:
                yield -(-time // period)


def _groups(root: Path, controller: str) -> Iterator[Path]:
    """Folders of the control groups, version 1 or 2, that hold this process, from the innermost outwards.

    In a container the path may be one of the host; the limit is then that of the mounted top.
    """
    mounted = root / "sys/fs/cgroup"
    for line in _text(root / "proc/self/cgroup").splitlines():
        _, controllers, path = line.split(":", 2)
        if not controllers or controller in controllers.split(","):
            inner = mounted / (controller if controllers else "") / path.lstrip("/")
            yield from (folder for folder in (inner, *inner.parents) if folder.is_relative_to(mounted))


def _text(file: Path) -> str:
    try:
        return file.read_text()
    except (OSError, UnicodeDecodeError):
        return ""
