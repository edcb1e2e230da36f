"""Kinds of features compared on warps of an image: python -m tests.benchmarks.features [IMAGE | FOLDER …].

An image (by default the CC0 photo among the development images, else synthetic ground) is rendered at 1600 x 1200
before and after known homographies, with noise. A folder holds images img1 … img6 and homographies H1to2p … H1to6p,
as the Oxford sets of Mikolajczyk and Schmid do.

Printed are means over the warps: keypoints per image; repeatability (share of the keypoints of image 1 within
image 2 that have one within 3 px there); matches within 1 and 3 px of the truth, and the share of the latter;
median error of those; CPU time relative to cv2's SIFT with its defaults in the same run; memory that the first image
adds at its peak.
"""

import argparse
import contextlib
import multiprocessing
import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features import FeatureOptions, Features, detect, match
from rdstitch.synthetic import ground

PHOTO = Path(__file__).resolve().parents[2] / "../shared/data/textures_cc0/IMG_161122_163239_0001_RGB.JPG"
SIZE = (1600, 1200)
NOISE = 2.0  # standard deviation, grey levels
FULL_SIZE = FeatureOptions(work_megapixels=None, max_features=4000)
ROWS = {
    "rootsift": FULL_SIZE,
    "sift": replace(FULL_SIZE, kind="sift"),
    "surf": replace(FULL_SIZE, kind="surf"),
    "surf, upright": replace(FULL_SIZE, kind="surf", surf_upright=True),
    "surf, extended": replace(FULL_SIZE, kind="surf", surf_extended=True),
    "surf, boxes only": replace(FULL_SIZE, kind="surf", surf_refine=False),
    "orb": replace(FULL_SIZE, kind="orb"),
    "akaze": replace(FULL_SIZE, kind="akaze"),
}

Grey = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images and the homography from the first to the second."""

    name: str
    first: Grey
    second: Grey
    homography: FloatArray


def rendered(image: Grey) -> Iterator[Pair]:
    """Warps of an image: rotations, scales, tilts."""
    width, height = SIZE
    # The image is shown at half its resolution: as sharp as cameras are, and with a margin to turn into view.
    shrink = max(0.5, width / image.shape[1], height / image.shape[0])
    small = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    margin = (np.array([small.shape[1], small.shape[0]]) - SIZE) / 2
    crop = np.array([[1, 0, -margin[0]], [0, 1, -margin[1]], [0, 0, 1]])
    rng = np.random.default_rng(0)

    def render(homography: FloatArray) -> Grey:
        view = cv2.warpPerspective(small, homography @ crop, SIZE, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        noisy = view + rng.normal(0.0, NOISE, view.shape)
        return np.asarray(np.clip(np.rint(noisy), 0, 255), np.uint8)

    first = render(np.eye(3))
    for name, degrees, scale, tilt in (
        ("rotation 10", 10, 1.0, 0.0),
        ("rotation 30", 30, 1.0, 0.0),
        ("rotation 45", 45, 1.0, 0.0),
        ("rotation 90", 90, 1.0, 0.0),
        ("scale 0.75", 5, 0.75, 0.0),
        ("scale 1.3", 5, 1.3, 0.0),
        ("tilt", 20, 1.0, 0.35),
    ):
        center = np.array([[1, 0, -(width - 1) / 2], [0, 1, -(height - 1) / 2], [0, 0, 1]])
        c, s = scale * np.cos(np.radians(degrees)), scale * np.sin(np.radians(degrees))
        motion = np.array([[c, -s, 0], [s, c, 0], [tilt / width, tilt / height, 1]])
        homography = np.linalg.inv(center) @ motion @ center
        yield Pair(name, first, render(homography), homography)


def measured(folder: Path) -> Iterator[Pair]:
    """The pairs of an Oxford-style folder."""
    files = {path.stem: path for path in folder.iterdir() if path.stem.startswith("img")}
    first = read(files["img1"])
    for index in range(2, 7):
        homography = np.loadtxt(folder / f"H1to{index}p")
        yield Pair(f"{folder.name} 1-{index}", first, read(files[f"img{index}"]), homography)


def read(path: Path) -> Grey:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise SystemExit(f"{path}: cannot read the image")
    return np.asarray(image, np.uint8)


def transfer(homography: FloatArray, points: FloatArray) -> FloatArray:
    return np.asarray(cv2.perspectiveTransform(points[None], homography)[0], np.float64)


def judge(pair: Pair, one: Features, two: Features) -> tuple[float, ...]:
    """Keypoints, repeatability, matches within 1 px and 3 px, their share, median error."""
    target = transfer(pair.homography, one.points)
    height, width = pair.second.shape
    visible = ((target > 0) & (target < (width - 1, height - 1))).all(axis=1)
    near = cv2.distanceTransform(np.where(drawn(two.points, (width, height)), 0, 255).astype(np.uint8), cv2.DIST_L2, 5)
    u, v = np.rint(target[visible]).astype(int).T
    found = match(one, two)
    error = np.linalg.norm(transfer(pair.homography, found.points1) - found.points2, axis=1)
    correct = error < 3
    return (
        (len(one) + len(two)) / 2,
        float((near[v, u] <= 3).mean()),
        float((error < 1).sum()),
        float(correct.sum()),
        float(correct.mean()),
        float(np.median(error[correct])),
    )


def drawn(points: FloatArray, size: tuple[int, int]) -> NDArray[np.bool_]:
    """An image that is True where a point is."""
    image = np.zeros((size[1], size[0]), dtype=bool)
    u, v = np.clip(np.rint(points), 0, np.array(size) - 1).astype(int).T
    image[v, u] = True
    return image


def cpu_time(work: object, *arguments: object) -> float:
    """Least CPU time of three runs, s."""
    times = []
    for _ in range(3):
        start = time.process_time()
        work(*arguments)  # type: ignore[operator]
        times.append(time.process_time() - start)
    return min(times)


def peak_memory(job: tuple[Grey, FeatureOptions | None]) -> float:
    """Memory that detection adds at its peak, MB; in a process of its own. Without options: cv2's SIFT."""
    image, options = job
    cv2.setNumThreads(1)
    detect(np.zeros((64, 64), np.uint8), FeatureOptions(kind="surf"))  # what imports and tables take
    # Linux forgets the peak so far when told to; elsewhere smaller peaks than that of the imports read as 0.
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    before = peak()
    if options is None:
        cv2.SIFT.create().detectAndCompute(image, None)
    else:
        detect(image, options)
    return peak() - before


def peak() -> float:
    """Largest memory of this process so far, MB."""
    status = Path("/proc/self/status")
    if status.exists():
        return next(int(line.split()[1]) / 1024 for line in status.read_text().splitlines() if "VmHWM" in line)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("inputs", nargs="*", type=Path, metavar="IMAGE|FOLDER")
    inputs = parser.parse_args().inputs
    cv2.setNumThreads(1)
    if not inputs and not PHOTO.exists():
        texture = ground((3200, 2400), 1, 1).region(0, 0, 3200, 2400).reshape(2400, 3200)
        pairs = list(rendered(np.clip(np.rint(texture * 255), 0, 255).astype(np.uint8)))
    else:
        pairs = [
            pair for path in inputs or [PHOTO] for pair in (measured(path) if path.is_dir() else rendered(read(path)))
        ]
    image = pairs[0].first
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        memory = pool.map(peak_memory, [(image, None), *((image, options) for options in ROWS.values())], 1)
    sift = cpu_time(cv2.SIFT.create().detectAndCompute, image, None)
    print(
        f"{len(pairs)} pairs, first image {image.shape[1]} x {image.shape[0]}; cv2's SIFT with its defaults: "
        f"{sift:.2f} s, {memory[0]:.0f} MB\n"
    )
    print("| features | keypoints | repeatability | 1 px | 3 px | precision | error px | CPU time | MB |")
    print("| --- | --: | --: | --: | --: | --: | --: | --: | --: |")
    by_angle = {}
    for (name, options), megabytes in zip(ROWS.items(), memory[1:], strict=True):
        firsts: dict[int, Features] = {}
        scores = []
        for pair in pairs:
            if id(pair.first) not in firsts:
                firsts[id(pair.first)] = detect(pair.first, options)
            scores.append(judge(pair, firsts[id(pair.first)], detect(pair.second, options)))
        seconds = cpu_time(detect, image, options)
        count, repeatability, one, three, precision, error = np.mean(scores, axis=0)
        print(
            f"| {name} | {count:.0f} | {repeatability:.2f} | {one:.0f} | {three:.0f} | {precision:.3f} | {error:.2f} "
            f"| {seconds / sift:.2f} | {megabytes:.0f} |",
            flush=True,
        )
        by_angle[name] = [score[3] for score in scores]
    print("\nCorrect matches within 3 px, pair by pair:\n")
    print("| features | " + " | ".join(pair.name for pair in pairs) + " |")
    print("| --- |" + " --: |" * len(pairs))
    for name, counts in by_angle.items():
        print(f"| {name} | " + " | ".join(f"{count:.0f}" for count in counts) + " |")


if __name__ == "__main__":
    main()
