"""Compositing measured: python -m tests.benchmarks.compositing [mosaic] [gigapixel] [--megapixels N].

mosaic
    12 rendered colour images of 11 Mpx, as JPEG files: rdstitch's compositing alone with the true homographies, the
    whole of ``rdstitch mosaic``, OpenCV's Stitcher in SCANS mode and, where it is installed beside ``--peer-python``,
    ``stitch --affine`` of the package stitching, each a process of its own, with output as ``.jpg`` and as ``.tif``.
    Printed are processor and wall time, their ratio to those of SCANS for the same format, and peak memory.
gigapixel
    Mosaics of images that are made on the fly, a quarter of ``--megapixels`` and all of it: time per output px,
    peak memory, and what tifffile sees in the file.

Every figure is of one run in a process of its own; the machine's other work shows in wall time, hardly in the rest.
"""

import argparse
import multiprocessing
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.compositing import CompositeOptions, OutputFile, compose_to_file, place_images, plan_canvas
from rdstitch.io import DecodedImage, Metadata, read_image
from rdstitch.synthetic import Photometry, grid_poses, ground, sequence_over

LENS = Camera((3880, 2850), distortion=-0.03, focal=3100.0)
COLUMNS, ROWS, OVERLAP = 4, 3, 0.5


@dataclass(frozen=True)
class Cost:
    """What one process took: seconds of wall and processor time, peak of resident memory in MB."""

    wall: float
    processor: float
    peak: float
    result: Any = None

    def row(self, name: str, peer: "Cost | None" = None) -> str:
        """One line of a table."""
        ratio = "" if peer is None else f"{self.wall / peer.wall:8.2f} {self.processor / peer.processor:8.2f}"
        return f"{name:34} {self.wall:8.1f} {self.processor:8.1f} {self.peak:8.0f} {ratio}"


HEAD = f"{'':34} {'wall s':>8} {'proc. s':>8} {'peak MB':>8} {'wall':>8} {'proc.':>8} of OpenCV's"


def measured(task: Callable[..., Any], *arguments: Any) -> Cost:
    """Run a function in a fresh process."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_run, args=(sender, task, arguments))
    process.start()
    sender.close()
    cost: Cost = receiver.recv()
    process.join()
    return cost


def _run(sender: Any, task: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    start = time.perf_counter()
    result = task(*arguments)
    wall = time.perf_counter() - start
    own, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    processor = sum(use.ru_utime + use.ru_stime for use in (own, children))
    sender.send(Cost(wall, processor, max(own.ru_maxrss, children.ru_maxrss) / 1024, result))


def render(folder: Path) -> FloatArray:
    """Twelve images as JPEG files; returns their true homographies to the plane."""
    poses = grid_poses(LENS, COLUMNS, ROWS, overlap=OVERLAP, yaw=0.05, shift=0.04, seed=1)
    photometry = Photometry(gain=np.linspace(0.85, 1.15, len(poses)), vignetting=0.25, noise=0.008)
    plane = partial(ground, seed=2)
    sequence = replace(sequence_over(plane, LENS, poses, photometry=photometry), samples=1)
    for index in range(len(sequence)):
        frame = cv2.cvtColor(sequence.frame(index), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / f"frame_{index:02d}.jpg"), frame, [cv2.IMWRITE_JPEG_QUALITY, 92])
    assert LENS.focal is not None
    scale = np.diag([LENS.half_diagonal / LENS.focal] * 2 + [1.0])
    return np.stack([np.linalg.inv(sequence.from_plane(i)) @ scale for i in range(len(sequence))])


def composite_files(paths: list[Path], homographies: FloatArray, output: Path, **options: Any) -> tuple[int, int]:
    """Our compositing alone."""
    cameras = [LENS] * len(paths)
    sources = [partial(read_image, path) for path in paths]
    canvas = plan_canvas(cameras, homographies)
    images = place_images(sources, cameras, homographies, preview=sources)
    done = compose_to_file(OutputFile(output), images, canvas, CompositeOptions(**options))
    return done.canvas.size


def whole_run(paths: list[Path], output: Path) -> str:
    """The command, from files to file."""
    command = [sys.executable, "-m", "rdstitch_cli", "mosaic", *map(str, paths), "-o", str(output), "--overwrite"]
    program = "import sys; from rdstitch_cli.main import main; sys.argv[0] = 'rdstitch'; main()"
    done = subprocess.run([sys.executable, "-c", program, *command[3:]], capture_output=True, text=True, check=False)
    return f"λ {done.stdout.strip()}" if done.returncode == 0 else f"status {done.returncode}: {done.stderr.strip()}"


PEER = """
import sys, cv2
stitcher = cv2.Stitcher.create(cv2.Stitcher_SCANS)
status, image = stitcher.stitch([cv2.imread(path) for path in sys.argv[2:]])
if status:
    sys.exit(f"failed with status {status}")
cv2.imwrite(sys.argv[1], image)
print(f"OpenCV {cv2.__version__}: {image.shape[1]} x {image.shape[0]} px", end="")
"""


def opencv_scans(python: str, paths: list[Path], output: Path) -> str:
    """OpenCV's Stitcher with its defaults for scans."""
    command = [python, "-c", PEER, str(output), *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout or f"fails: {done.stderr.strip().splitlines()[-1]}"


def stitch_affine(command: Path, paths: list[Path], output: Path) -> str:
    """The command of the package stitching."""
    names = [str(command), "--affine", *map(str, paths), "--output", str(output)]
    done = subprocess.run(names, capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else f"fails: {done.stderr.strip().splitlines()[-1]}"


def section_mosaic(peer_python: str) -> None:
    """12 images of 11 Mpx."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        homographies = render(folder)
        paths = sorted(folder.glob("*.jpg"))
        print(f"12 images of {LENS.image_size[0]} x {LENS.image_size[1]}")
        print(HEAD)
        stitching = Path(peer_python).with_name("stitch")
        for kind in (".jpg", ".tif"):
            peer = measured(opencv_scans, peer_python, paths, folder / f"opencv{kind}")
            print(peer.row(f"OpenCV Stitcher, SCANS, {kind}", peer), peer.result)
            if stitching.exists():
                other = measured(stitch_affine, stitching, paths, folder / f"stitching{kind}")
                print(other.row(f"stitch --affine, {kind}", peer), other.result)
            whole = measured(whole_run, paths, folder / f"mosaic{kind}")
            print(whole.row(f"rdstitch mosaic, {kind}", peer), whole.result)
            ours = measured(composite_files, paths, homographies, folder / f"composite{kind}")
            print(ours.row(f"rdstitch, compositing alone, {kind}", peer), "{} x {} px".format(*ours.result))


def made_frame(index: int, tile: NDArray[np.uint8]) -> DecodedImage:
    """An image without rendering: shifted texture, so that reading costs next to nothing."""
    frame = np.roll(tile, (37 * index, 61 * index), axis=(0, 1))
    return DecodedImage(frame, None, Metadata((frame.shape[1], frame.shape[0])))


def flight(megapixels: float, size: tuple[int, int], overlap: float) -> tuple[list[Camera], FloatArray]:
    """A square block of images side by side that covers so many megapixels, slightly turned and tilted."""
    lens = Camera(size, distortion=-0.03)
    step = (1.0 - overlap) * np.array(size) / lens.half_diagonal
    columns, rows = (max(1, round((megapixels * 1e6) ** 0.5 / ((1.0 - overlap) * n))) for n in size)
    rng = np.random.default_rng(0)
    matrices = []
    for row in range(rows):
        for column in range(columns):
            yaw, (tilt_x, tilt_y) = rng.uniform(-0.02, 0.02), rng.uniform(-0.005, 0.005, 2)
            cos, sin = np.cos(yaw), np.sin(yaw)
            x, y = np.array([column, row]) * step
            matrix = np.array([[cos, -sin, x], [sin, cos, y], [0.0, 0.0, 1.0]])
            matrices.append(matrix @ np.array([[1.0, 0, 0], [0, 1, 0], [tilt_x, tilt_y, 1.0]]))
    return [lens] * len(matrices), np.stack(matrices)


def composite_flight(megapixels: float, channels: int, output: Path, options: dict[str, Any]) -> dict[str, Any]:
    """A mosaic of made images."""
    size = (4000, 3000)
    cameras, matrices = flight(megapixels, size, overlap=0.25)
    rng = np.random.default_rng(1)
    coarse = rng.integers(30, 220, (size[1] // 4, size[0] // 4, channels), dtype=np.uint8)
    tile = np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    canvas = plan_canvas(cameras, matrices)
    sources = [partial(made_frame, index, tile) for index in range(len(cameras))]
    images = place_images(sources, cameras, matrices)
    done = compose_to_file(OutputFile(output), images, canvas, CompositeOptions(**options))
    return {"images": len(cameras), "size": done.canvas.size, "coverage": done.coverage}


def section_gigapixel(megapixels: float, channels: int) -> None:
    """Time proportional to the output, memory not."""
    rates = []
    for share in (0.25, 1.0):
        with tempfile.TemporaryDirectory() as name:
            output = Path(name) / "large.tif"
            cost = measured(composite_flight, share * megapixels, channels, output, {})
            width, height = cost.result["size"]
            rates.append(cost.processor / (width * height / 1e6))
            with tifffile.TiffFile(output) as tiff:
                page = tiff.pages.first
                corner = page.asarray() if width * height < 1e8 else None
                seen = f"{page.shape} {page.dtype}, bigtiff {tiff.is_bigtiff}, {len(tiff.pages)} levels"
                assert corner is None or corner.shape[:2] == (height, width)
            print(f"{cost.result['images']} images of 12 Mpx -> {width} x {height} = {width * height / 1e6:.0f} Mpx")
            print(
                f"    wall {cost.wall:.0f} s, processor {cost.processor:.0f} s ({1000 * rates[-1]:.0f} ms/Mpx), "
                f"peak {cost.peak:.0f} MB, file {output.stat().st_size / 2**20:.0f} MB: {seen}"
            )
    print(f"processor time per px, large to small: {rates[1] / rates[0]:.2f}")


def main() -> None:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sections", nargs="*", choices=["mosaic", "gigapixel", []], default=["mosaic", "gigapixel"])
    parser.add_argument("--megapixels", type=float, default=1000.0, help="output of the gigapixel section")
    parser.add_argument("--channels", type=int, choices=[1, 3], default=3, help="of its images")
    parser.add_argument(
        "--peer-python", default=sys.executable, help="interpreter whose OpenCV stitches; 5.0.0 fails, 4 does not"
    )
    given = parser.parse_args()
    if "mosaic" in given.sections:
        section_mosaic(given.peer_python)
    if "gigapixel" in given.sections:
        section_gigapixel(given.megapixels, given.channels)


if __name__ == "__main__":
    main()
