"""Sharpness and exposure of an image."""

import math
from dataclasses import dataclass, replace
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ImageQuality:
    """How sharp and how bright an image is."""

    sharpness: float  # contrast of the finest detail over that of twice as coarse detail, 0 without any
    brightness: float  # the mean, 0 to 1
    burnt_out: float  # fraction of its pixels
    full_scale: float = math.nan  # of samples of 16 bits, that of as many bits as they need

    def at_full_scale(self, full: float) -> Self:
        """The same where samples of 16 bits fill so much of them in the brightest image of the same sensor."""
        if math.isnan(self.full_scale):
            return self
        part = self.full_scale / full
        return replace(self, brightness=self.brightness * part, burnt_out=0.0 if part < 1.0 else self.burnt_out)

    @classmethod
    def of(cls, samples: NDArray[Any], alpha: NDArray[np.uint8] | None) -> Self:
        """Measure an image (H, W) or (H, W, C) of uint8, uint16 or float32, where it is opaque."""
        full, peak = 255.0, float(samples.max(where=np.isfinite(samples), initial=1e-12))
        if samples.dtype != np.uint8:
            full = 2.0 ** max(8, int(peak).bit_length()) - 1.0 if samples.dtype == np.uint16 else peak
        grey = samples if samples.ndim == 2 else samples[..., : min(3, samples.shape[2])].mean(axis=2)
        grey = np.ascontiguousarray(grey, dtype=np.float32) / np.float32(full)
        measured = np.isfinite(grey)
        seen = measured if alpha is None else measured & (alpha > 0)
        if not seen.any():
            return cls(0.0, 0.0, 0.0)
        grey[~measured] = grey[seen].mean()
        height, width = (max(1, round(side / 2)) for side in grey.shape)
        coarse = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
        fine = float(np.abs(cv2.Laplacian(grey, cv2.CV_32F))[seen].mean())
        rough = float(np.abs(cv2.Laplacian(coarse, cv2.CV_32F)).mean())
        return cls(
            sharpness=fine / rough if rough > 1e-6 else 0.0,
            brightness=float(grey[seen].mean()),
            burnt_out=float((grey >= np.float32(254 / 255))[seen].mean()),
            full_scale=full if samples.dtype == np.uint16 else math.nan,
        )
