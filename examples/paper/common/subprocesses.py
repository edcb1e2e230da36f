"""Programs within limits of time and memory, their exit status, wall time and peak memory."""

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

_LAUNCHER = Path(__file__).with_name("launcher.py")
_MAX_MEMORY = 8 << 30  # bytes of address space: a mosaic that runs away must not take the machine with it
_SAID = 120  # characters of a program's last line that are kept


@dataclass(frozen=True)
class Run:
    """What became of one or several programs run one after the other."""

    status: int | None  # exit status of the last one that ran; negative for a signal, None when the time was up
    seconds: float  # wall time
    processor_seconds: float  # processor time of all of them; of one that was ended, without what its own children used
    megabytes: float  # largest resident memory of any of them, 10⁶ bytes
    said: str  # last line on standard error

    @property
    def ok(self) -> bool:
        """Whether the last one succeeded, and with it all."""
        return self.status == 0


def run_all(commands: Sequence[Sequence[str]], folder: Path, timeout: float) -> Run:
    """Run commands one after the other until one fails or the time is up.

    ``folder``: working directory. ``timeout``: seconds for all of them.
    """
    begun = time.perf_counter()
    status: int | None = 0
    processor, megabytes, said = 0.0, 0.0, ""
    for command in commands:
        left = timeout - (time.perf_counter() - begun)
        launched = [sys.executable, "-I", "-S", str(_LAUNCHER), str(left), str(_MAX_MEMORY), *command]
        done = subprocess.run(launched, cwd=folder, capture_output=True, text=True, errors="replace", check=True)
        told = json.loads(done.stdout)
        status, lines = told["status"], done.stderr.strip().splitlines()
        processor += told["processor_seconds"]
        megabytes = max(megabytes, told["kilobytes"] / 1e3)
        said = lines[-1][:_SAID] if lines else ""
        if status != 0:
            break
    return Run(status, time.perf_counter() - begun, processor, megabytes, said)
