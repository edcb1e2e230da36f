"""Matching compared with cv2.BFMatcher, the same matches demanded: python -m tests.benchmarks.matching [N]."""

import sys
import time
import tracemalloc
from collections.abc import Callable
from typing import TypeVar

import cv2
import numpy as np

from rdstitch.features import Features, match
from rdstitch.features.keypoints import Descriptors

RATIO = 0.8
T = TypeVar("T")


def features(descriptors: Descriptors) -> Features:
    """Features with given descriptors, each at a place of its own."""
    count = len(descriptors)
    zeros = np.zeros(count)
    points = np.column_stack([np.arange(count), zeros]).astype(np.float64)
    return Features(points, descriptors, zeros + 1, zeros, zeros, None, "benchmark")


def images(kind: str, count: int) -> tuple[Features, Features]:
    """Descriptors of two images: half of them show the same."""
    rng = np.random.default_rng(0)
    half = np.arange(count)[:, None] < count // 2
    if kind == "sift":
        raw, other = rng.gamma(0.6, size=(2, count, 128))
        other = np.where(half, raw * rng.uniform(0.7, 1.3, raw.shape), other)
        unit = [values / np.linalg.norm(values, axis=1, keepdims=True) for values in (raw, other)]
        one, two = (np.rint(512 * values).astype(np.float32) for values in unit)
        return features(one), features(two[rng.permutation(count)])
    width = 32
    bits, fresh = rng.integers(0, 256, (2, count, width), dtype=np.uint8)
    flips = rng.integers(0, 256, bits.shape, dtype=np.uint8) & rng.integers(0, 256, bits.shape, dtype=np.uint8)
    return features(bits), features(np.where(half, bits ^ flips, fresh)[rng.permutation(count)])


def brute_force(one: Features, two: Features) -> set[tuple[int, int]]:
    """Mutual matches that pass the ratio test both ways, by cv2."""
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING if one.binary else cv2.NORM_L2)
    passed = [
        {
            (m.queryIdx, m.trainIdx)
            for m, n in matcher.knnMatch(a.descriptors, b.descriptors, k=2)
            if m.distance < RATIO * n.distance
        }
        for a, b in ((one, two), (two, one))
    ]
    return passed[0] & {(i, j) for j, i in passed[1]}


def timed(work: Callable[[], T], runs: int) -> tuple[T, float]:
    """Result and least processor time, s."""
    times = []
    for _ in range(runs):
        start = time.process_time()
        result = work()
        times.append(time.process_time() - start)
    return result, min(times)


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    cv2.setNumThreads(1)
    print(f"{count} x {count} descriptors, one thread (set OMP_NUM_THREADS=1)\n")
    print("| descriptors | matches | identical | cv2.BFMatcher s | rdstitch s | ratio | peak MB |")
    print("| --- | --: | --- | --: | --: | --: | --: |")
    for kind in ("sift", "orb"):
        one, two = images(kind, count)
        expected, slow = timed(lambda one=one, two=two: brute_force(one, two), 1)  # type: ignore[misc]
        found, fast = timed(lambda one=one, two=two: match(one, two, RATIO), 3)  # type: ignore[misc]
        identical = expected == {(int(i), int(j)) for i, j in found.indices}
        tracemalloc.start()
        match(one, two, RATIO)
        peak = tracemalloc.get_traced_memory()[1] / 2**20
        tracemalloc.stop()
        print(
            f"| {kind} | {len(found)} | {'yes' if identical else 'NO'} | {slow:.2f} | {fast:.2f} "
            f"| {slow / fast:.1f} | {peak:.0f} |"
        )


if __name__ == "__main__":
    main()
