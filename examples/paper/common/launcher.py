"""Run one command within limits and tell how it went: ``python launcher.py SECONDS BYTES COMMAND …``.

It is a script of its own because the kernel counts the memory of the process that forks a command as the command's:
this one is small. It prints as JSON the exit status, null when the time was up, the peak memory in kB, and
the processor time of the command and all that it has waited for.
"""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

_POLL = 0.02  # s


def main() -> None:
    """Run the command that the arguments give."""
    seconds, memory, command = float(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]
    # What a command starts in turn has the same limit.
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stdin=subprocess.DEVNULL)
    end = time.perf_counter() + seconds
    code: int | None = None
    while True:
        done, status, usage = os.wait4(process.pid, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            break
        if time.perf_counter() > end:
            _kill(process.pid)
            _, _, usage = os.wait4(process.pid, 0)
            break
        time.sleep(_POLL)
    process.returncode = -1
    seconds = usage.ru_utime + usage.ru_stime
    print(json.dumps({"status": code, "kilobytes": usage.ru_maxrss, "processor_seconds": seconds}))


def _kill(parent: int) -> None:
    """End a process and all that it has started, those in groups of their own included."""
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == parent:
            _kill(int(entry.parent.name))
    os.kill(parent, signal.SIGKILL)


if __name__ == "__main__":
    main()
