"""Multi-band blending (Burt and Adelson 1983), such that tiles give bit for bit what one piece gives.

Every band is blended with the weights smoothed to its own scale, so that a seam is as wide as the detail it crosses.
The arithmetic is exact: samples and weights are multiples of a power of two that leave float32 room for the sums of the
pyramid's kernels (1, 4, 6, 4, 1) / 16, and are rounded to such multiples after every step. Sums then do not depend on
their order, nor on where a tile begins.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np

from rdstitch.arrays import Float32Array
from rdstitch.compositing.boxes import Box

_WEIGHT_STEPS = np.float32(4096.0)


def margin(bands: int) -> int:
    """How far, pixels, a result can depend on the pixels around it.

    A pixel of band l reaches, up and down the pyramid, 2 (2^l - 1) pixels; the Laplacian adds as much of the next band.
    """
    return 4 << bands


def rounding_constant(full: float, integer: bool) -> np.float32:
    """Adding and subtracting it rounds float32 to multiples that leave 8 bits for a kernel's sum; 0 for no rounding.

    8-bit samples are rounded to 1/16, 16-bit samples to 1. Floating-point samples have no such bound; tiles of them
    agree to float32's precision only.
    """
    if not integer:
        return np.float32(0.0)
    return np.float32(1.5 * 2.0**23 * (1.0 / 16.0 if full < 256 else 1.0))


def rounded(values: Float32Array, constant: np.float32) -> Float32Array:
    """Round in place to the multiples that the constant gives."""
    if constant:
        values += constant
        values -= constant
    return values


@dataclass(eq=False)
class MultibandBlender:
    """Sums of weighted Laplacian bands on one box."""

    box: Box  # on the canvas, aligned to the coarsest band
    bands: int
    channels: int
    constant: np.float32  # of :func:`rounding_constant`
    _sums: list[Float32Array] = field(default_factory=list)
    _weights: list[Float32Array] = field(default_factory=list)

    def __post_init__(self) -> None:
        width, height = self.box[2] - self.box[0], self.box[3] - self.box[1]
        for band in range(self.bands + 1):
            shape = (height >> band, width >> band)
            self._sums.append(np.zeros((*shape, self.channels), dtype=np.float32))
            self._weights.append(np.zeros(shape, dtype=np.float32))

    def add(self, box: Box, pixels: Float32Array, weight: Float32Array) -> None:
        """Add an image's (h, w, C) samples and (h, w) weights on an aligned box within the blender's.

        ``pixels`` is used up.
        """
        level = rounded(pixels, self.constant)
        weights = np.ceil(weight * _WEIGHT_STEPS) / _WEIGHT_STEPS
        x, y = box[0] - self.box[0], box[1] - self.box[1]
        for band in range(self.bands + 1):
            band_pixels = level
            if band < self.bands:
                coarser = rounded(_down(level), self.constant)
                band_pixels = rounded(_up(coarser), self.constant)
                np.subtract(level, band_pixels, out=band_pixels)
                level = coarser
            height, width = weights.shape
            cut = np.s_[y >> band : (y >> band) + height, x >> band : (x >> band) + width]
            band_pixels *= per_channel(weights, self.channels)
            self._sums[band][cut] += band_pixels
            self._weights[band][cut] += weights
            if band < self.bands:
                # Rounded up: where a weight is not 0, it must not become 0.
                weights = np.ceil(_down(weights[..., None])[..., 0] * _WEIGHT_STEPS) / _WEIGHT_STEPS

    def result(self) -> Float32Array:
        """The blended samples (h, w, C); meaningless near the box' border and where no weight was."""
        result = np.zeros(0, dtype=np.float32)
        for band in range(self.bands, -1, -1):
            weights = self._weights[band]
            np.maximum(weights, 1.0 / _WEIGHT_STEPS, out=weights)
            blended = self._sums[band]
            blended /= per_channel(weights, self.channels)
            rounded(blended, self.constant)
            if band < self.bands:
                blended += rounded(_up(result), self.constant)
            result = blended
        return result


def per_channel(plane: Float32Array, channels: int) -> Float32Array:
    """A plane (h, w) repeated for every channel, (h, w, C): a product with that is several times faster than with a
    last axis of length 1.
    """
    if channels == 1:
        return plane[..., None]
    return np.asarray(cv2.merge([plane] * channels), dtype=np.float32)


def _down(values: Float32Array) -> Float32Array:
    done = cv2.pyrDown(values)
    return np.asarray(done, dtype=np.float32).reshape(*done.shape[:2], values.shape[2])


def _up(values: Float32Array) -> Float32Array:
    done = cv2.pyrUp(values)
    return np.asarray(done, dtype=np.float32).reshape(*done.shape[:2], values.shape[2])
