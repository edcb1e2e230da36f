"""What spreading keypoints does to λ: python -m tests.benchmarks.spreading [FOLDER LAMBDA] [--kinds K,…] [--sizes].

Features are detected at full size with and without spreading, matched, and λ is estimated for every pair: on rendered
pairs of known lens (dark and noisy towards the corners, as real ones are), or on consecutive images of a folder whose
λ is given. With --sizes they are spread, and detected at full and at half size.
Printed for each way: pairs of which λ was estimated, the median number of inliers, median and root mean square of λ's
error (errors above 0.2 count as 0.2), and the median share of inliers in the outer quarter of the image.
"""

import argparse
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch import Camera, estimate_radial_homography
from rdstitch.features import FeatureOptions, Features, detect, match
from rdstitch.synthetic import Photometry, ground, pair_poses, sequence_over

SIZE = (1000, 750)
PAIRS = 10
MAX_ERROR = 0.2

Images = tuple[list[NDArray[np.uint8]], list[tuple[int, int]], list[float]]


def rendered() -> Images:
    """Pairs with 30 to 60 % overlap, λ from -0.4 to -0.1."""
    rng = np.random.default_rng(0)
    images, distortions = [], []
    for index in range(PAIRS):
        distortion = float(rng.uniform(-0.4, -0.1))
        lens = Camera(SIZE, distortion, focal=float(rng.uniform(700, 1000)))
        poses = pair_poses(
            lens,
            overlap=float(rng.uniform(0.3, 0.6)),
            yaw=float(rng.uniform(-0.3, 0.3)),
            direction=float(rng.uniform(0, 6.28)),
            tilt=(float(rng.normal(0, 0.03)), float(rng.normal(0, 0.03))),
        )
        photometry = Photometry(vignetting=0.7, blur=0.8, noise=0.015)
        sequence = sequence_over(
            partial(ground, seed=index, channels=1), lens, poses, photometry=photometry, seed=index
        )
        images += [np.asarray(frame, np.uint8) for frame in sequence.frames()]
        distortions.append(distortion)
    return images, [(2 * i, 2 * i + 1) for i in range(PAIRS)], distortions


def photographed(folder: Path, distortion: float) -> Images:
    """Consecutive images of a folder."""
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(folder.iterdir())]
    read = [np.asarray(image, np.uint8) for image in images if image is not None]
    pairs = [(i, i + 1) for i in range(len(read) - 1)]
    return read, pairs, [distortion] * len(pairs)


def errors(
    features: list[Features], pairs: list[tuple[int, int]], truth: list[float]
) -> Iterator[tuple[float, int, float]]:
    """λ's error, inliers and their share in the outer quarter of the image, of each pair that has a result."""
    for (i, j), distortion in zip(pairs, truth, strict=True):
        size = features[i].image_size
        assert size is not None
        found = match(features[i], features[j])
        if len(found) < 20:
            continue
        result = estimate_radial_homography(found.points1, found.points2, size, solver="five_point")
        if result.ok:
            points = np.vstack([found.points1[result.inliers], found.points2[result.inliers]])
            radius = np.linalg.norm(points - (np.array(size) - 1) / 2, axis=1) / (np.hypot(*size) / 2)
            # A quarter of a 4:3 image lies beyond 0.76 half diagonals.
            yield abs(result.distortion - distortion), int(result.inliers.sum()), float((radius > 0.76).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("distortion", nargs="?", type=float)
    parser.add_argument("--kinds", default="rootsift,orb", help="kinds of features, separated by commas")
    parser.add_argument("--sizes", action="store_true", help="compare sizes instead of choices")
    arguments = parser.parse_args()
    kinds = arguments.kinds.split(",")
    if arguments.folder is None:
        images, pairs, truth = rendered()
    else:
        images, pairs, truth = photographed(arguments.folder, arguments.distortion)
    choices = at_sizes(kinds) if arguments.sizes else with_and_without(kinds)
    print("| features | choice | pairs | inliers | median error of λ | rms | in the outer quarter |")
    print("| --- | --- | --: | --: | --: | --: | --: |")
    for choice, options in choices:
        rows = list(errors([detect(image, options) for image in images], pairs, truth))
        error, inliers, outer = np.array(rows).reshape(-1, 3).T
        rms = np.sqrt(np.mean(np.minimum(error, MAX_ERROR) ** 2))
        print(
            f"| {options.kind}, {options.max_features} | {choice} | {len(rows)} of {len(pairs)} "
            f"| {np.median(inliers):.0f} | {np.median(error):.4f} | {rms:.4f} | {np.median(outer):.2f} |",
            flush=True,
        )


def with_and_without(kinds: list[str]) -> Iterator[tuple[str, FeatureOptions]]:
    """Few and many keypoints, the strongest and spread."""
    for kind in kinds:
        for count in (1000, 4000):
            for spread in (False, True):
                options = FeatureOptions(kind=kind, spread=spread, max_features=count, work_megapixels=None)
                yield "spread" if spread else "strongest", options


def at_sizes(kinds: list[str]) -> Iterator[tuple[str, FeatureOptions]]:
    """The images whole and halved, if they have 0.5 to 2 megapixels."""
    for kind in kinds:
        for choice, megapixels in (("halved", 0.5), ("full size", None)):
            yield choice, FeatureOptions(kind=kind, work_megapixels=megapixels, max_features=4000)


if __name__ == "__main__":
    main()
