"""Strips over rough ground: ``python -m examples.benchmarks.relief [--sets N] [--images N]``.

Every set is a strip of images by one camera over hills ("bumps"), buildings or ridges ("slopes") of 2, 5 or 10 % of
its height, or over a plane, as matches with 0.3 pixels of noise and 10 % outliers, through two-view estimation and
alignment. Printed a row:

one camera
    Sets in which a model of one camera was chosen, not free homographies.
shape
    Largest displacement of an image's centre, after a similarity, per cent of the strip's length: median and largest.
relief
    Sets in which relief was noticed.
λ
    Of the strip and its windows of 2, 4 and 8 images: windows in which λ is called observable, the share of them with
    ``|λ - truth| <= 3 σ``, and the median of ``|λ - truth| / σ`` and of σ.
"""

import time
from collections.abc import Iterator

import numpy as np

from examples.benchmarks.driver import run
from examples.worlds.relief_strips import Strip, displacement, strip
from rdstitch.alignment import AlignmentOptions, align
from rdstitch.alignment.result import Alignment
from rdstitch.errors import RdstitchError
from rdstitch.synthetic import RELIEFS

HEIGHTS = (0.02, 0.05, 0.1)


def windows(item: Strip, images: int, seed: int) -> Iterator[tuple[int, Strip]]:
    """The whole, and two windows of each length."""
    rng = np.random.default_rng((seed, 3))
    yield images, item
    for count in (2, 4, 8):
        for first in rng.integers(0, images - count + 1, 2).tolist():
            yield count, item.window(first, count)


def main(
    *, sets: int = 2, first: int = 0, images: int = 40, kind: str | None = None, height: float | None = None
) -> None:
    """Print a row for every kind of ground."""
    rows = [("flat", 0.0), *((kind, height) for height in HEIGHTS for kind in RELIEFS)]
    ratios: dict[int, list[float]] = {}
    for ground, rise in rows:
        if kind not in (None, ground) or height not in (None, rise):
            continue
        start, shapes, cameras, noticed, own = time.process_time(), [], 0, 0, dict[int, list[tuple[float, float]]]()
        for seed in range(first, first + sets):
            item = strip(ground, rise, seed, images)
            for count, part in windows(item, images, seed):
                found = _aligned(part)
                if found is None:
                    continue
                if count == images:
                    shapes.append(displacement(item, found))
                    cameras += found.model != "homography"
                    noticed += found.relief.found
                error = abs(found.distortion - item.distortion)
                own.setdefault(count, []).append((error, found.distortion_std))
        shapes = shapes or [np.nan]
        print(
            f"{ground} {rise:.0%}: one camera {cameras} of {sets}, "
            f"shape {100 * np.median(shapes):.2f} ({100 * max(shapes):.2f}) %, relief {noticed}, "
            + "; ".join(_of_distortion(count, pairs) for count, pairs in sorted(own.items()))
            + f"; {time.process_time() - start:.0f} s",
            flush=True,
        )
        for count, pairs in own.items():
            ratios.setdefault(count, []).extend(error / std for error, std in pairs if np.isfinite(std))
    for count, ratio in sorted(ratios.items()):
        share, median = np.mean(np.array(ratio) <= 3.0), np.median(np.array(ratio))
        print(f"all windows of {count}: {share:.0%} within 3 σ, median {median:.2f}")
    every = np.concatenate([*map(np.array, ratios.values())])
    print(f"all: {len(every)}, {np.mean(every <= 3.0):.1%} within 3 σ, median {np.median(every):.2f}")


def _aligned(part: Strip) -> Alignment | None:
    try:
        return align(part.cameras, part.links, AlignmentOptions())
    except RdstitchError:
        return None


def _of_distortion(count: int, pairs: list[tuple[float, float]]) -> str:
    observable = np.array([pair for pair in pairs if np.isfinite(pair[1])]).reshape(-1, 2)
    if not len(observable):
        return f"{count}: none of {len(pairs)} observable"
    ratio = observable[:, 0] / observable[:, 1]
    return (
        f"{count}: {len(observable)} of {len(pairs)}, {np.mean(ratio <= 3.0):.0%}, {np.median(ratio):.2f} "
        f"(σ {np.median(observable[:, 1]):.4f})"
    )


if __name__ == "__main__":
    run(main)
