"""Runs with ``--cache`` that are killed at random moments and continue from the cache."""

import random
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.floor_drives import floor_drive

_PROGRAM = """
import os, sys, time
from importlib import import_module
log = os.open(sys.argv.pop(1), os.O_WRONLY | os.O_APPEND | os.O_CREAT)
def watch(module, name, count):
    module = import_module(module)
    function = getattr(module, name)
    def counted(*arguments, **options):
        os.write(log, f"{name} {count(*arguments)} begun\\n".encode())
        begun = time.thread_time()
        result = function(*arguments, **options)
        os.write(log, f"{name} {time.thread_time() - begun} seconds\\n".encode())
        return result
    setattr(module, name, counted)
watch("rdstitch.features.detect", "_detect", lambda *a: 1)
watch("rdstitch.features.match", "_match_signs", lambda *a: 1)
watch("rdstitch.matching.two_view", "estimate_radial_homographies", lambda pairs, *a: len(pairs))
from rdstitch_cli.main import main
main()
"""


def run(log: Path, arguments: list[str], seconds: float | None = None) -> float:
    """Seconds of a run of the command line; killed after ``seconds``."""
    begun = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, str(log), *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        status = process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    else:
        assert status == 0, arguments
    return time.monotonic() - begun


def totals(log: Path, unit: str) -> dict[str, float]:
    """How many detections of images, and matchings and estimations of pairs, were begun; or what they took."""
    found: dict[str, float] = {}
    for line in log.read_text(encoding="ascii").splitlines():
        name, amount, own = line.split()
        if own == unit:
            found[name] = found.get(name, 0.0) + float(amount)
    return found


def repeated(frames: int, kills: int, seed: int = 0) -> tuple[dict[str, float], bool]:
    """Share of each kind of work that was begun again, and of all by its time; and whether the result is the same."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "frames").mkdir()
        floor_drive("parking", frames, seed=7, size=(480, 360)).write(folder / "frames")
        outputs = [folder / "plain" / "out.tif", folder / "killed" / "out.tif"]
        logs = [folder / "plain.log", folder / "killed.log"]
        for output in outputs:
            output.parent.mkdir()
        # Threads of one process: only there can calls be counted.
        arguments = ["mosaic", str(folder / "frames"), "-j", "1", "--overwrite", "--cache"]
        whole = run(logs[0], [*arguments, str(folder / "plain-cache"), "-o", str(outputs[0])])
        moments = random.Random(seed)
        again = [*arguments, str(folder / "cache"), "-o", str(outputs[1])]
        for _ in range(kills):
            # So that the last kills still meet a run at work.
            run(logs[1], again, moments.uniform(0.0, 2.0 * whole / kills) + 1.0)
        run(logs[1], again)
        plain, killed = (totals(log, "begun") for log in logs)
        seconds = totals(logs[0], "seconds")
        shares = {kind: killed[kind] / count - 1.0 for kind, count in plain.items()}
        shares["all work"] = sum(shares[kind] * taken for kind, taken in seconds.items()) / sum(seconds.values())
        return shares, outputs[0].read_bytes() == outputs[1].read_bytes()
