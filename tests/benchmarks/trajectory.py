"""``rdstitch trajectory`` on rendered floor frames, no setting given: how near it comes to the truth, at what cost.

python -m tests.benchmarks.trajectory [--frames 80 160 320] [--path line] [--seed 5]

The frames are slices of a robot's paths (paper §5.5), through a lens of λ = -0.25. Translations and rotations are those
between consecutive frames; translations are compared after the best scaling, since frames without a known focal
length do not tell the height. Times and memory are those of the command's process; the ratio is of processor time per
frame to that of the fewest frames of the path.
"""

import argparse
import math
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from rdstitch.alignment.trajectory import Trajectory, compare_trajectories
from tests.floor_drives import DISTORTION, PATHS, floor_drive, read_path, true_path

_PROGRAM = "from rdstitch_cli.main import main; main()"
_COLUMNS = ("path", "frames", "used", "transl. %", "drift %", "rot. °", "Δλ", "s/frame", "cpu s/frame", "ratio", "MB")


@dataclass(frozen=True)
class Run:
    """What one run of the command wrote and took: λ, seconds, seconds of processor time, MB."""

    distortion: float
    path: Trajectory
    wall: float
    processor: float
    memory: float


def command(folder: Path, output: Path) -> Run:
    """Run ``rdstitch trajectory`` on the frames of a folder, in a process of its own."""
    start = time.perf_counter()
    arguments = [sys.executable, "-c", _PROGRAM, "trajectory", str(folder), "-o", str(output), "-q"]
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process.stdout:
        printed = process.stdout.read()
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise SystemExit(f"the command ended with status {process.returncode}")
    wall = time.perf_counter() - start
    return Run(float(printed), read_path(output), wall, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


def main() -> None:
    """Print one line per path and number of frames."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, nargs="+", default=[80, 160, 320], help="lengths of the sequences")
    parser.add_argument("--path", choices=PATHS, help="only this path")
    parser.add_argument("--seed", type=int, default=5, help="of floor and noise")
    wanted = parser.parse_args()
    print("".join(f"{column:>12}" for column in _COLUMNS))
    for name in [wanted.path] if wanted.path else PATHS:
        least = math.nan
        for count in sorted(wanted.frames):
            sequence = floor_drive(name, count, seed=wanted.seed)
            with TemporaryDirectory() as folder:
                frames = Path(folder) / "frames"
                frames.mkdir()
                sequence.write(frames)
                run = command(frames, Path(folder) / "path.csv")
            error, each = compare_trajectories(run.path, true_path(sequence)), run.processor / count
            least = each if math.isnan(least) else least
            row = f"{name:>12}{count:12d}{len(run.path):12d}"
            row += f"{100 * error.translation_in_own_unit:12.4f}{100 * error.drift:12.4f}"
            row += f"{math.degrees(error.rotation):12.5f}{run.distortion - DISTORTION:12.6f}"
            print(f"{row}{run.wall / count:12.2f}{each:12.2f}{each / least:12.2f}{run.memory:12.0f}", flush=True)


if __name__ == "__main__":
    main()
