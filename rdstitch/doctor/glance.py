"""One look at each image and at pairs of them, on small versions: sharpness, exposure, overlap."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.features import Features, match
from rdstitch.io.read import DecodedImage

_SAMPLES = 200  # minimal samples of a pair
_THRESHOLD = 0.05  # of the diagonal: error of a similarity that stands for distortion and perspective
_MIN_SUPPORT = 8  # matches beyond the two that define it; chance gives about one in 50
_GRID = 24  # points a side by which an overlap is measured


@dataclass(frozen=True)
class Glance:
    """What one image shows at a glance.

    Attributes
    ----------
    sharpness : float
        Contrast of the finest detail over that of twice as coarse detail; an image without detail has 0.
    brightness : float
        Mean of the samples, 0 to 1.
    clipped : float
        Share of pixels that are burnt out.
    """

    sharpness: float
    brightness: float
    clipped: float


def glance_at(image: DecodedImage) -> Glance:
    """Sharpness and exposure of an image."""
    samples = image.pixels
    full = float(np.iinfo(samples.dtype).max) if samples.dtype.kind == "u" else float(max(samples.max(), 1e-12))
    grey = samples if samples.ndim == 2 else samples[..., : min(3, samples.shape[2])].mean(axis=2)
    grey = np.ascontiguousarray(grey, dtype=np.float32) / np.float32(full)
    seen = np.ones(grey.shape, dtype=bool) if image.alpha is None else image.alpha > 0
    if not seen.any():
        return Glance(0.0, 0.0, 0.0)
    coarse = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    fine = float(np.abs(cv2.Laplacian(grey, cv2.CV_32F))[seen].mean())
    rough = float(np.abs(cv2.Laplacian(coarse, cv2.CV_32F)).mean())
    burnt = grey >= np.float32(254 / 255)
    return Glance(fine / rough if rough > 1e-6 else 0.0, float(grey[seen].mean()), float(burnt[seen].mean()))


def overlap_of(features1: Features, features2: Features) -> float:
    """Share of the first image that the second one shows, by the similarity that most matches support; 0 for none.

    Parameters
    ----------
    features1, features2 : Features
        A few hundred each.
    """
    found = match(features1, features2)
    size1, size2 = features1.image_size, features2.image_size
    if len(found) < _MIN_SUPPORT + 2 or size1 is None or size2 is None:
        return 0.0
    # As complex numbers, a similarity is z2 = a z1 + b.
    z1, z2 = (points @ np.array([1.0, 1.0j]) for points in (found.points1, found.points2))
    rng = np.random.default_rng(0)
    i, j = rng.integers(0, len(z1), (2, _SAMPLES))
    apart = np.abs(z1[i] - z1[j]) > _THRESHOLD * np.hypot(*size1)
    i, j = i[apart], j[apart]
    if not len(i):
        return 0.0
    a = (z2[i] - z2[j]) / (z1[i] - z1[j])
    b = z2[i] - a * z1[i]
    off = np.abs(a[:, None] * z1 + b[:, None] - z2)
    support = (off < _THRESHOLD * np.hypot(*size2)).sum(axis=1)
    # Zooms of more than two are no neighbours of a row.
    support[(np.abs(a) < 0.5) | (np.abs(a) > 2.0)] = 0
    best = int(np.argmax(support))
    if support[best] < _MIN_SUPPORT + 2:
        return 0.0
    return _share(a[best], b[best], size1, size2)


def _share(a: complex, b: complex, size1: tuple[int, int], size2: tuple[int, int]) -> float:
    across, down = (np.linspace(0.0, extent - 1.0, _GRID) for extent in size1)
    mapped: NDArray[np.complex128] = a * (across[None, :] + 1j * down[:, None]) + b
    inside: FloatArray = (
        (mapped.real >= 0) & (mapped.real < size2[0]) & (mapped.imag >= 0) & (mapped.imag < size2[1])
    ).astype(np.float64)
    return float(inside.mean())
