"""A tile made small, as overlaps are looked for: its content, and how much of that is noise."""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.io.reduction import block_mean
from rdstitch.numerics.robust_loss import normal_std

Image = NDArray[np.float32]

CORRELATED = 4.0 * math.pi  # pixels that share their noise after a Gaussian filter of 1 pixel
_ILLUMINATION = 0.25  # share of a tile's side over which its illumination, or the medium's glow, is even


@dataclass(frozen=True, eq=False)
class CoarseTile:
    """A tile as overlaps are looked for."""

    pixels: Image  # (h, w)
    content: Image  # (h, w): without most of its noise, without the illumination, and less bright where it is bright
    noise: float  # variance of the noise of a pixel in units of the content

    @property
    def content_fraction(self) -> float:
        """Share of the variance of the content that is none of noise."""
        return 1.0 - self.noise / CORRELATED / max(float(self.content.var()), 1e-12)

    @property
    def grain(self) -> float:
        """Radius of the area that is alike, pixels: peaks that are no farther from each other are one."""
        squares, slopes = float(np.vdot(self.content, self.content)), energies(self.content)[1]
        return max(2.0, math.sqrt(2.0 * squares / max(slopes, 1e-30)))


def coarse_tile(tile: NDArray[Any], factor: int) -> CoarseTile:
    """Make a tile (h, w) smaller by a factor, and separate its content from noise and illumination."""
    image = np.asarray(block_mean(tile, factor), dtype=np.float32)
    noise = noise_variance(image)
    side = max(3, round(_ILLUMINATION * max(image.shape)) | 1)
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    light = smooth - np.float32(np.median(smooth))
    # The brightest spot must not be all that counts.
    scale = max(4.0 * math.sqrt(noise / CORRELATED), 1.5 * float(np.median(np.abs(light))), 0.1 * float(light.std()))
    light = np.arcsinh(light / np.float32(max(scale, 1e-12)))
    even = cv2.blur(light, (side, side), borderType=cv2.BORDER_REFLECT)
    return CoarseTile(image, np.asarray(light - even, dtype=np.float32), noise / max(scale, 1e-12) ** 2)


def noise_variance(part: Image) -> float:
    """Variance of white noise in an image, by second differences, which content hardly has; half of them count."""
    rows = part[::2]
    second = rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:]
    return normal_std(second) ** 2 / 6.0 if second.size else 0.0


def energies(image: Image) -> tuple[float, float]:
    """Sums of the fourth powers of samples, and of the squares of their differences from neighbours."""
    squares = image * image
    # By OpenCV, which takes a third of the time, and gives None for no pixels.
    slopes = cv2.subtract(image[1:], image[:-1]), cv2.subtract(image[:, 1:], image[:, :-1])
    return float(np.vdot(squares, squares)), sum(float(np.vdot(slope, slope)) for slope in slopes if slope is not None)
