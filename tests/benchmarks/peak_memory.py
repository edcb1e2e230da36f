"""The peak memory of a measured process."""

import resource
import sys
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path


def peak_memory() -> float:
    """Most memory that this process has held, MB (10⁶ bytes).

    On Linux since its program began: ``ru_maxrss`` is never less than what the parent held when it started this one.
    """
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


@dataclass
class StagePeaks:
    """Most memory that was held in each stage, MB; a progress of recipes. Linux only."""

    held: dict[str, float] = field(default_factory=dict)

    def __call__(self, stage: str, done: int, total: int) -> None:
        """What was held since the last report belongs to the stage that now reports."""
        self.held[stage] = max(self.held.get(stage, 0.0), peak_memory())
        # The peak begins anew: see proc(5).
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
