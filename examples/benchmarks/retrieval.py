"""How many of the pairs that overlap are candidates: ``python -m examples.benchmarks.retrieval [COUNT …] [--ordered]``.

A drone's survey of 320 x 240 frames is rendered, its features are detected, and the candidate pairs of the shuffled
frames are compared with the pairs that truly overlap: those whose footprints on the plane share so much of the smaller
one.
"""

import time

import cv2
import numpy as np
from scipy.spatial import KDTree

from examples.benchmarks.driver import run
from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.features import FeatureOptions, detect
from rdstitch.matching.candidate_pairs import first_pairs
from rdstitch.matching.feature_store import FeatureStore
from rdstitch.synthetic import Photometry, Sequence, ground, sequence_over, survey_poses
from rdstitch.synthetic.poses import plane_outline

OVERLAPS = (0.1, 0.25, 0.3, 0.4)


def survey(count: int, seed: int) -> Sequence:
    """Frames that overlap by 70 % along a lane and by 50 % across; every second lane is flown upside down."""
    lens = Camera((320, 240), -0.2, focal=0.8 * 320)
    poses = survey_poses(lens, count, yaw_jitter=0.1, height_jitter=0.1, attitude_jitter=0.03, seed=seed)
    return sequence_over(
        lambda size: ground(size, seed=seed), lens, poses, photometry=Photometry(noise=0.01), seed=seed
    )


def overlaps(footprints: list[FloatArray]) -> dict[tuple[int, int], float]:
    """Area that two footprints have in common, relative to the smaller one, of every pair that has any."""
    corners = [outline.astype(np.float32) for outline in footprints]
    areas = [cv2.contourArea(outline) for outline in corners]
    centres = np.array([outline.mean(axis=0) for outline in footprints])
    reach = max(float(np.ptp(outline, axis=0).max()) for outline in footprints)
    found = {}
    for i, j in sorted(KDTree(centres).query_pairs(1.5 * reach)):
        common, _ = cv2.intersectConvexConvex(cv2.convexHull(corners[i]), cv2.convexHull(corners[j]))
        if common > 0.0:
            found[i, j] = common / min(areas[i], areas[j])
    return found


def main(
    counts: tuple[int, ...] = (100, 300, 1000), *, ordered: bool = False, features: int = 1000, seed: int = 5
) -> None:
    """Print one line per number of frames."""
    print("frames  candidates a frame  ms a frame  " + "  ".join(f"overlap ≥ {least:.2f}" for least in OVERLAPS))
    for count in counts:
        sequence = survey(count, seed)
        order = np.arange(count) if ordered else np.random.default_rng(seed).permutation(count)
        options = FeatureOptions(max_features=features)
        store = FeatureStore.of(detect(sequence.frame(index), options) for index in order.tolist())
        begun = time.process_time()
        pairs = set(first_pairs(store, seed=0))
        taken = time.process_time() - begun
        shared = overlaps(list(plane_outline(sequence.lens, sequence.poses.from_plane()[order])))
        line = f"{count:6d}{2 * len(pairs) / count:20.1f}{1e3 * taken / count:12.1f}  "
        for least in OVERLAPS:
            truly = {pair for pair, share in shared.items() if share >= least}
            line += f"{len(truly & pairs) / max(len(truly), 1):14.4f}  "
        print(line, flush=True)


if __name__ == "__main__":
    run(main)
