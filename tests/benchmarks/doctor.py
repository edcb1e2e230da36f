"""What ``rdstitch doctor`` expects beside what a run takes: ``python -m tests.benchmarks.doctor [FOLDER …]``.

Without folders, rendered sets. Time is processor time, and what the doctor expects is multiplied by the number of
processors, so that other load does not count; memory is the largest resident size of a process of its own.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from rdstitch.camera import Camera
from rdstitch.doctor import examine
from rdstitch.synthetic import Photometry, grid_poses, ground, sequence_over
from tests.benchmarks.peak_memory import peak_memory

_RENDERED = ((640, 480, 4, 3), (1280, 960, 4, 3), (1280, 960, 8, 5), (2400, 1800, 4, 3))
"""Width, height, and images of a grid."""


def measured(folder: Path, output: Path) -> tuple[float, float]:
    """Processor time, s, and peak memory, MB, of ``rdstitch mosaic``."""
    command = [sys.executable, "-m", __name__.replace("__main__", "tests.benchmarks.doctor"), "--run", str(output)]
    done = subprocess.run([*command, str(folder)], check=True, capture_output=True, text=True)
    seconds, megabytes = json.loads(done.stdout)
    return seconds, megabytes


def run(folder: Path, output: Path) -> None:
    """Stitch, and print what it took."""
    from rdstitch.pipeline import StitchOptions, mosaic

    mosaic([folder], output, StitchOptions(overwrite=True, force=True))
    usage = resource.getrusage(resource.RUSAGE_SELF)
    print(json.dumps([usage.ru_utime + usage.ru_stime, peak_memory()]))


def compare(name: str, folder: Path, output: Path) -> None:
    """One line."""
    expected = examine([folder])
    seconds, megabytes = measured(folder, output)
    wanted = expected.seconds * (os.cpu_count() or 1)
    print(
        f"{name:24s}{expected.images:5d}{wanted:9.0f}{seconds:9.1f}{wanted / seconds:8.2f}"
        f"{expected.memory_bytes / 2**20:9.0f}{megabytes:9.0f}{expected.memory_bytes / 2**20 / megabytes:8.2f}",
        flush=True,
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="What the doctor expects beside what a run takes")
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--run", type=Path, metavar="OUT", help="stitch the folder, for a process of its own")
    wanted = parser.parse_args()
    if wanted.run is not None:
        run(wanted.folders[0], wanted.run)
        return
    print(f"{'set':24s}{'n':>5s}{'s, exp.':>9s}{'s':>9s}{'ratio':>8s}{'MB, exp.':>9s}{'MB':>9s}{'ratio':>8s}")
    with TemporaryDirectory() as scratch:
        output = Path(scratch) / "out.jpg"
        for folder in wanted.folders:
            compare(folder.name, folder, output)
        for width, height, columns, rows in () if wanted.folders else _RENDERED:
            lens = Camera((width, height), -0.2, focal=0.9 * width)
            poses = grid_poses(lens, columns, rows, overlap=0.5, yaw=0.1, seed=1)
            look = Photometry(noise=0.01, blur=0.5)
            sequence = sequence_over(lambda size: ground(size, 1), lens, poses, photometry=look, seed=1)
            folder = Path(scratch) / f"{width}x{height}x{columns * rows}"
            folder.mkdir()
            sequence.write(folder, "p{:02d}.jpg")
            compare(f"rendered {folder.name}", folder, output)


if __name__ == "__main__":
    main()
