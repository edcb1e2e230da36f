"""Panoramas by rotation, measured: ``python -m examples.benchmarks.panoramas [NAME …]``.

Rendered sets of a camera that turns on the spot, with known rotations, λ and focal length. Errors are those of
directions, in pixels of the images, after the best rotation of the whole; "closes" is the largest error of the
transfer between neighbours, all the way round. OpenCV's stitcher runs on the same images, with one thread, several
times: what it finds, and its time, depend on its random numbers. Its times are printed in ascending order, and how many
times its median rdstitch takes. All are processor times of registration, checks and compositing.
"""

import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from examples.benchmarks.driver import run
from examples.worlds.turns import TurningSequence, panorama_rotations, turning_sequence
from rdstitch.alignment import Alignment
from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.recipes import pano
from rdstitch.synthetic import Photometry

Pixels = NDArray[np.uint8]
SIZE, FOCAL = (640, 480), 554.0
# Images of a row, degrees between them, rows, λ.
SETS: dict[str, tuple[int, float, int, float]] = {
    "3": (3, 25.0, 1, -0.2),
    "6": (6, 25.0, 1, -0.2),
    "6 strong": (6, 25.0, 1, -0.45),
    "13": (13, 360.0 / 13, 1, -0.2),
    "13 straight": (13, 360.0 / 13, 1, 0.0),
    "13 x 2": (13, 360.0 / 13, 2, -0.2),
}


def rendered(name: str) -> TurningSequence:
    """One of the sets; headings, pitches and rolls are off by up to 3 degrees."""
    count, step, rows, distortion = SETS[name]
    rotations = panorama_rotations(count, np.radians(step), rows=rows, jitter=np.radians(3.0), seed=count + rows)
    lens = Camera(SIZE, distortion, focal=FOCAL, focal_source="option")
    return turning_sequence(lens, rotations, seed=count + rows, photometry=Photometry(blur=0.5, noise=0.008))


def direction_errors(truth: TurningSequence, found: Alignment) -> FloatArray:
    """Distances, pixels, between measured points and where the found camera sees what is there, over all images."""
    width, height = SIZE
    grid = np.stack(np.meshgrid(np.linspace(0, width - 1, 15), np.linspace(0, height - 1, 11)), axis=-1).reshape(-1, 2)
    used = np.flatnonzero(found.used)
    true = [truth.rays(int(k), grid) for k in used]
    seen = []
    for k in used:
        flat = found.cameras[k].normalize(found.cameras[k].undistort(grid))
        rays = np.column_stack([flat, np.ones(len(flat))]) @ found.homographies[k].T
        seen.append(rays / np.linalg.norm(rays, axis=1, keepdims=True))
    left, _, right = np.linalg.svd(np.concatenate(seen).T @ np.concatenate(true))
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    errors = []
    for k, rays in zip(used, true, strict=True):
        x, y, z = np.linalg.solve(found.homographies[k], turn @ rays.T)
        places = found.cameras[k].distort(found.cameras[k].denormalize(np.stack([x / z, y / z], axis=1)))
        errors.append(np.linalg.norm(places - grid, axis=1))
    return np.concatenate(errors)


def closing_error(truth: TurningSequence, found: Alignment) -> float:
    """Largest error of the transfer of an image's centre to its neighbour, pixels; the last one's is the first."""
    middle = np.array([[(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2]])
    k = np.diag([FOCAL, FOCAL, 1.0])
    worst, count = 0.0, len(truth)
    for i in range(count):
        j = (i + 1) % count
        x, y, z = k @ truth.rotations[j] @ truth.rotations[i].T @ np.array([0.0, 0.0, 1.0])
        expected = truth.lens.distort(np.array([[x / z, y / z]]) + middle) if z > 0.0 else np.full((1, 2), np.nan)
        error = float(np.linalg.norm(found.transfer(i, j, middle) - expected))
        worst = max(worst, error) if np.isfinite(error) else worst
    return worst


def stitched_by_opencv(images: list[Pixels], seeds: int) -> tuple[list[int], list[float]]:
    """Images used by OpenCV's stitcher, 0 where it fails, and its processor times, s, with several seeds."""
    used, seconds = [], []
    for seed in range(seeds):
        cv2.setRNGSeed(seed)
        stitcher = cv2.Stitcher.create(cv2.Stitcher_PANORAMA)
        start = time.process_time()
        status, _ = stitcher.stitch(images)
        seconds.append(time.process_time() - start)
        used.append(0 if status else len(stitcher.component()))
    return used, sorted(seconds)


def main(names: tuple[str, ...] = tuple(SETS), *, seeds: int = 5) -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    head = f"{'set':12s}{'used':>8s}{'Δλ':>10s}{'Δf %':>9s}{'median px':>11s}{'closes px':>11s}{'s':>7s}"
    print(f"{head}  times OpenCV's: used, s")
    for name in names or SETS:
        truth = rendered(name)
        with tempfile.TemporaryDirectory() as folder:
            paths = truth.write(folder, "p{:02d}.png")
            start = time.process_time()
            found = pano(paths, Path(folder) / "out.jpg", StitchOptions(workers=1)).registration.alignment
            seconds = time.process_time() - start
            images = [np.asarray(cv2.imread(str(path)), np.uint8) for path in paths]
        focal = (found.focal or np.nan) * np.hypot(*SIZE) / 2
        print(
            f"{name:12s}{found.used.sum():4d}/{len(truth):<3d}{found.distortion - SETS[name][3]:10.5f}"
            f"{100 * (focal / FOCAL - 1):9.4f}{np.median(direction_errors(truth, found)):11.4f}"
            f"{closing_error(truth, found) if SETS[name][0] == 13 else np.nan:11.3f}{seconds:7.1f}",
            end="  ",
            flush=True,
        )
        used, peer = stitched_by_opencv(images, seeds)
        times = " ".join(f"{t:.1f}" for t in peer)
        print(f"{seconds / np.median(peer):5.2f}: {min(used)} to {max(used)} used, {times}", flush=True)


if __name__ == "__main__":
    run(main)
