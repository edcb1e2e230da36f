"""Peak memory by stage: ``python -m examples.benchmarks.memory FOLDER [--width PIXELS] [--count N] [--workers N]``.

The images of a folder, enlarged to a width, are stitched into a TIFF file by a process of its own, as ``mosaic``
does. Printed is the most memory that it held in each stage, beside what is allowed. Linux only.
"""

import subprocess
import sys
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2

import rdstitch
from examples.benchmarks.driver import StagePeaks, images_of, run
from rdstitch.io.read import read_image
from rdstitch.io.write import write_image

_BOUND, _BOUND_OF_AN_IMAGE = 400.0, 0.15  # MB


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


def main(
    folder: Path, *, width: int = 4000, count: int | None = None, workers: int = 0, run_here: bool = False
) -> None:
    """Print one line a stage."""
    if run_here:
        stitch(folder, workers)
        return
    files = images_of(folder)
    with TemporaryDirectory() as name:
        enlarge(list(islice(files, count)), width, Path(name))
        command = [sys.executable, "-m", "examples.benchmarks.memory", name, "--run-here", "--workers", str(workers)]
        subprocess.run(command, check=True)


if __name__ == "__main__":
    run(main)
