"""Masks: images that say which part of another image counts."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rdstitch.arrays import UInt8Array
from rdstitch.errors import InputError
from rdstitch.geometry.exif_orientation import inverse, turned, turned_size
from rdstitch.io.metadata import read_metadata
from rdstitch.io.read import read_image
from rdstitch.io.samples import OPAQUE, as_alpha


@dataclass(frozen=True)
class Mask:
    """An image that is dark where another one does not count."""

    path: Path
    frame: int | None = None  # how it is turned, see :func:`mask_frame`

    def read(self, size: tuple[int, int]) -> UInt8Array:
        """Alpha (height, width) of an image of a size: 255 where it counts, 0 where it is excluded.

        What is darker than half of the mask's brightest value is excluded, so that masks of 0 and 1, masks of 0 and
        255, and lossily compressed ones all mean what they show. What is transparent in the mask is excluded, too.
        """
        mask = read_image(self.path)
        light = mask.pixels if mask.pixels.ndim == 2 else mask.pixels.max(axis=2)
        brightest = light.max()
        counts = light >= (brightest / 2 if brightest > 0 else 1)
        if mask.alpha is not None:
            counts &= mask.alpha >= (OPAQUE + 1) // 2
        if self.frame is not None:
            counts = turned(turned(counts, inverse(mask.metadata.orientation)), self.frame)
        height, width = counts.shape
        rows = (np.arange(size[1]) + 0.5) * (height / size[1])
        columns = (np.arange(size[0]) + 0.5) * (width / size[0])
        return as_alpha(counts[np.ix_(rows.astype(np.intp), columns.astype(np.intp))])


def mask_frame(
    path: str | Path, image: str | Path, size: tuple[int, int], orientation: int = 1, *, of_camera: bool = False
) -> int | None:
    """Find out from its header by which orientation a mask is to be turned to fit to an image; None as it looks.

    What the camera sees in every image belongs to the stored frame, as its lens does; the mask of one image is as
    that looks. Where a mask fits in one of the two only, it belongs there.
    """
    mask, (width, height) = read_metadata(path), size
    stored = turned_size(turned_size(mask.size, inverse(mask.orientation)), orientation)
    frames: list[tuple[int | None, tuple[int, int]]] = [(None, mask.size), (orientation, stored)]
    for frame, (w, h) in frames[::-1] if of_camera else frames:
        # Sizes are whole pixels, so that the shape may differ by one pixel of the larger.
        if abs(width * h - height * w) <= max(width, height, w, h):
            return frame
    raise InputError(
        f"{path}: a mask of {mask.size[0]} x {mask.size[1]} pixels does not fit on {image}, which has "
        f"{width} x {height} pixels; a mask has its image's size, or another size of the same shape"
    )
