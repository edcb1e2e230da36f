"""Where patches of one image are found in another, to a few hundredths of a pixel."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import Float32Array, FloatArray

_ITERATIONS = 5
_PATCHES = 5000
_PATCH = 33  # px, a side
# Patches that are refined together, as one tall image: OpenCV wants it lower than 32,768 px.
_BATCH = 256
# A patch whose refinement leaves the peak it started from has lost its way.
_FARTHEST_FROM_PEAK = 1.5
# Patches with a smaller standard deviation have no texture and are left out; what is less alike counts as not found.
_LEAST_CONTRAST, _LEAST_CORRELATION = 0.02, 0.7


@dataclass(frozen=True)
class Displacements:
    """Patches with texture, and where they were found.

    ``displacement``: from there to where the other image shows the same, px; NaN where it was not found; shape (P, 2).
    """

    center: FloatArray  # centre of each patch, px; shape (P, 2)
    displacement: FloatArray

    @property
    def found(self) -> NDArray[np.bool_]:
        """Which patches were found, shape (P,)."""
        found: NDArray[np.bool_] = np.all(np.isfinite(self.displacement), axis=1)
        return found


def patch_displacements(
    image: Float32Array, other: Float32Array, valid: NDArray[np.bool_], search: int
) -> Displacements:
    """Look for patches of an image in another one that shows nearly the same.

    Each patch of a regular grid is looked for by normalized cross-correlation, and from the best whole pixel on by
    least squares over shift, gain and offset (Lucas and Kanade).

    ``image``, ``other``: in [0, 1]; shape (h, w). ``valid``: where ``image`` and ``other`` mean something; a patch must
    lie inside with all its px; shape (h, w). ``search``: largest displacement along each axis, px.
    """
    patch, half = _PATCH, _PATCH // 2
    step = max(24, int(np.sqrt(image.size / _PATCHES)))
    inside = cv2.erode(valid.astype(np.uint8), np.ones((patch, patch), np.uint8), borderValue=(0.0,)) > 0
    height, width = image.shape
    y, x = (g.ravel() for g in np.mgrid[half : height - half : step, half : width - half : step])
    keep = inside[y, x]
    y, x = y[keep], x[keep]
    windows = np.lib.stride_tricks.sliding_window_view(image, (patch, patch))
    templates = windows[y - half, x - half].copy() if len(x) else np.empty((0, patch, patch), np.float32)
    textured = templates.std(axis=(1, 2)) >= _LEAST_CONTRAST
    templates, y, x = templates[textured], y[textured], x[textured]
    center = np.column_stack([x, y]).astype(np.float64)

    padded = cv2.copyMakeBorder(other, search, search, search, search, cv2.BORDER_REPLICATE)
    peak = np.empty((len(center), 2))
    for k, template in enumerate(templates):
        top, left = y[k] - half, x[k] - half
        area = padded[top : top + patch + 2 * search, left : left + patch + 2 * search]
        best = cv2.minMaxLoc(cv2.matchTemplate(area, template, cv2.TM_CCOEFF_NORMED))[3]
        peak[k] = best[0] - search, best[1] - search
    displacement, correlation = np.empty_like(center), np.empty(len(center))
    slopes = [cv2.Sobel(other, cv2.CV_32F, dx, 1 - dx, scale=1 / 8) for dx in (1, 0)]
    layers = [other, *(np.asarray(slope, dtype=np.float32) for slope in slopes)]
    for first in range(0, len(center), _BATCH):
        part = np.s_[first : first + _BATCH]
        displacement[part], correlation[part] = _refine(templates[part], layers, center[part], peak[part])
    lost = (np.abs(displacement - peak) > _FARTHEST_FROM_PEAK).any(axis=1) | ~(correlation >= _LEAST_CORRELATION)
    displacement[lost] = np.nan
    return Displacements(center, displacement)


def _refine(
    templates: Float32Array, layers: list[Float32Array], center: FloatArray, start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Displacement (P, 2) that minimises the squared difference up to gain and offset, and the correlation there.

    ``layers`` are the other image and its derivatives along x and y.
    """
    count, patch = len(templates), templates.shape[1]
    offset = np.arange(patch) - patch // 2
    target = templates.reshape(count, -1)
    target = target - target.mean(axis=1, keepdims=True)
    displacement, correlation = start.copy(), np.full(count, np.nan)
    for _ in range(_ITERATIONS):
        x, y = (center[:, k, None] + displacement[:, k, None] + offset for k in (0, 1))
        maps = (
            np.broadcast_to(x[:, None, :], (count, patch, patch)).reshape(-1, patch).astype(np.float32),
            np.broadcast_to(y[:, :, None], (count, patch, patch)).reshape(-1, patch).astype(np.float32),
        )
        sampled = [cv2.remap(layer, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE) for layer in layers]
        # target ~ gain (value + dx along + dy down): linear in gain, gain dx and gain dy.
        basis = np.stack([layer.reshape(count, -1) for layer in sampled], axis=1)
        basis -= basis.mean(axis=2, keepdims=True)
        products = np.concatenate([basis, target[:, None]], axis=1) @ basis.transpose(0, 2, 1)
        normal, right = products[:, :3].astype(np.float64), products[:, 3].astype(np.float64)
        energy = np.maximum(normal[:, 0, 0], 1e-12)
        correlation = right[:, 0] / np.sqrt(energy * np.einsum("pi,pi->p", target, target))
        gain, dx, dy = np.linalg.solve(normal + 1e-9 * np.eye(3), right[:, :, None])[:, :, 0].T
        step = np.column_stack([dx, dy]) / np.where(gain > 0.1, gain, np.inf)[:, None]
        displacement = displacement + np.clip(step, -1.0, 1.0)
    return displacement, correlation
