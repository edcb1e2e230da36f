"""Peak memory by stage: ``python -m tests.benchmarks.memory FOLDER [--width PIXELS] [--count N] [--workers N]``.

The images of a folder, enlarged to a width, are stitched into a TIFF file by a process of its own, as ``mosaic``
does. Printed is the most memory that it held in each stage, beside what is allowed. Linux only.
"""

import argparse
import subprocess
import sys
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2

import rdstitch
from rdstitch.io.read import read_image
from rdstitch.io.write import write_image
from tests.benchmarks.peak_memory import StagePeaks

_BOUND, _BOUND_OF_AN_IMAGE = 400.0, 0.15  # MB
_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif")


def enlarge(images: list[Path], width: int, folder: Path) -> None:
    """Write images so many pixels wide."""
    for place, file in enumerate(images):
        pixels = read_image(file).pixels
        size = (width, round(width * pixels.shape[0] / pixels.shape[1]))
        write_image(folder / f"{place:05d}.jpg", cv2.resize(pixels, size, interpolation=cv2.INTER_CUBIC))


def stitch(folder: Path, workers: int) -> None:
    """Stitch a folder in this process, and print the peak of each stage."""
    peaks = StagePeaks()
    with TemporaryDirectory() as output:
        options = rdstitch.StitchOptions(workers=workers, force=True)
        rdstitch.mosaic([folder], Path(output) / "out.tif", options, progress=peaks)
    peaks("writing", 1, 1)
    count = sum(1 for _ in folder.iterdir())
    for stage, peak in peaks.held.items():
        print(f"{stage:24s}{peak:6.0f} MB")
    print(f"{'all':24s}{max(peaks.held.values()):6.0f} MB of {_BOUND + _BOUND_OF_AN_IMAGE * count:.0f}")


def main() -> None:
    """Print one line a stage."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--width", type=int, default=4000, help="pixels of the enlarged images")
    parser.add_argument("--count", type=int, help="only the first images")
    parser.add_argument("--workers", type=int, default=0, help="threads; 0: all cores")
    parser.add_argument("--run", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.run:
        stitch(given.folder, given.workers)
        return
    files = sorted(file for file in given.folder.iterdir() if file.suffix.lower() in _SUFFIXES)
    with TemporaryDirectory() as name:
        enlarge(list(islice(files, given.count)), given.width, Path(name))
        command = [sys.executable, "-m", "tests.benchmarks.memory", name, "--run", "--workers", str(given.workers)]
        subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
