"""How much overlapping images differ where they were put: ``python -m examples.benchmarks.overlaps FOLDER…``.

Every folder is a set, stitched with no option. All images are warped at full size, as they are blended; of each pair
that overlaps, the share of local structure that the two do not have in common is ``1 - NCC`` in windows of 15 x 15
pixels, 0 where they are the same and 1 where they have nothing in common, weighed by contrast. A row a set: images
used, the mean over all overlaps, and the worst pair; with ``--peer-python``, a Python that has the package
``stitching``, its images beside them.
"""

import tempfile
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

import rdstitch
from examples.benchmarks.driver import images_of, run
from examples.benchmarks.peer_layers import layers_of_peer

Layer = tuple[NDArray[np.uint8], NDArray[np.uint8], tuple[int, int]]
"""A warped image, BGR, its mask, and the place of its corner (x, y)."""

_WINDOW = (15, 15)
_NOISE = 4.0  # variance of grey levels that is no structure
_LEAST = 0.02  # share of an image from which on an overlap counts


def differences(layers: Sequence[Layer]) -> dict[str, float]:
    """Number of layers, mean difference of all overlaps, and that of the worst pair."""
    images = [_prepared(*layer) for layer in layers]
    pairs = [pair for one, other in combinations(images, 2) if (pair := _difference(one, other))[1] > 0.0]
    found, weights = np.array(pairs or [(np.nan, 1.0)]).T
    return {"used": len(layers), "mean": float(np.average(found, weights=weights)), "worst": float(found.max())}


def _prepared(image: NDArray[np.uint8], mask: NDArray[np.uint8], corner: tuple[int, int]) -> tuple[Any, ...]:
    """Smoothed grey levels, what is farther than a window from the border, and the corner."""
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32), (0, 0), 1.0)
    inside = cv2.erode(mask, np.ones(_WINDOW, np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0) > 127
    return grey, inside, np.array(corner)


def _difference(one: tuple[Any, ...], other: tuple[Any, ...]) -> tuple[float, float]:
    """Difference of two images in what they have in common, and its pixels; 0 pixels where that is too little."""
    low = np.maximum(one[2], other[2])
    high = np.minimum(*(corner + grey.shape[::-1] for grey, _, corner in (one, other)))
    if (high <= low).any():
        return 1.0, 0.0
    parts = [np.s_[y0:y1, x0:x1] for _, _, c in (one, other) for (x0, y0), (x1, y1) in [(low - c, high - c)]]
    both = one[1][parts[0]] & other[1][parts[1]]
    if both.sum() < _LEAST * min(one[1].sum(), other[1].sum()):
        return 1.0, 0.0
    a, b = one[0][parts[0]], other[0][parts[1]]
    means = [cv2.blur(values, _WINDOW) for values in (a, b)]
    variances = [np.maximum(cv2.blur(v * v, _WINDOW) - m * m, 0.0) for v, m in zip((a, b), means, strict=True)]
    covariance = cv2.blur(a * b, _WINDOW) - means[0] * means[1]
    correlation = covariance / np.sqrt((variances[0] + _NOISE) * (variances[1] + _NOISE))
    contrast = np.sqrt(variances[0] * variances[1]) * both
    return float(((1.0 - correlation) * contrast).sum() / max(contrast.sum(), 1e-9)), float(both.sum())


def our_layers(files: list[str]) -> list[Layer]:
    """Warp images as rdstitch does."""
    layers = []
    with tempfile.TemporaryDirectory() as folder:
        result = rdstitch.mosaic(files, f"{folder}/mosaic.png")
        for file in rdstitch.write_layers(result, f"{folder}/layers", whole=True):
            if not file.stem.endswith("_mask"):
                rgba = tifffile.imread(file)
                rows, columns = (np.flatnonzero(rgba[..., 3].any(axis=axis)) for axis in (1, 0))
                part = rgba[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
                layers.append((part[..., 2::-1].copy(), part[..., 3].copy(), (int(columns[0]), int(rows[0]))))
    return layers


def layers_of(files: list[str], peer_python: str | None) -> list[Layer]:
    """Warped images of a set, of rdstitch or of the package ``stitching``; none where that fails."""
    if peer_python is not None:
        return [(layer.pixels, layer.mask, layer.corner) for layer in layers_of_peer(peer_python, files)[0]]
    try:
        return our_layers(files)
    except rdstitch.RdstitchError:
        return []


def main(folders: tuple[Path, ...], *, peer_python: str | None = None) -> None:
    """Print a row a set."""
    programs = [None] if peer_python is None else [None, peer_python]
    print(
        "set                      images   used  mean  worst" + "   used  mean  worst (stitching)" * (len(programs) - 1)
    )
    for folder in folders:
        files = list(map(str, images_of(folder)))
        row = f"{folder.name:24s} {len(files):6d}"
        for program in programs:
            layers = layers_of(files, program)
            row += "   {:4d} {:.3f}  {:.3f}".format(*differences(layers).values()) if layers else "      0     -      -"
        print(row, flush=True)


if __name__ == "__main__":
    run(main)
