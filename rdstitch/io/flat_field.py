"""What every image of a camera gets of the light, pixel by pixel, and taking it out of samples."""

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from rdstitch.arrays import AnyArray, Float32Array
from rdstitch.errors import InputError
from rdstitch.io.opening import check_readable, decoding
from rdstitch.io.read_tiff import image_pages
from rdstitch.io.reduction import block_mean
from rdstitch.system.late_imports import tifffile


@dataclass(frozen=True, eq=False)
class FlatField:
    """Illumination of all images of a camera: ``measured = gain * light + dark``."""

    gain: Float32Array  # (h, w, C), float32: mean 1 in each channel
    dark: Float32Array  # (h, w, C) or (1, 1, C), float32: samples without light

    def corrected(self, pixels: AnyArray, reduction: int = 1) -> AnyArray:
        """``(v - dark) / gain + dark`` of samples (h, w) or (h, w, C), reduced or not, in their type.

        The dark level stays, so that noise about it is not cut off at 0.
        """
        gain, dark = (block_mean(a, reduction) if a.shape[0] > 1 else a for a in (self.gain, self.dark))
        flat = pixels.reshape(*pixels.shape[:2], -1)
        values = (flat.astype(np.float32) - dark) / gain.reshape(*pixels.shape[:2], -1) + dark
        if pixels.dtype.kind == "u":
            values = np.clip(np.rint(values), 0, np.iinfo(pixels.dtype).max)
        return values.astype(pixels.dtype).reshape(pixels.shape)

    def write(self, file: Path) -> None:
        """Write a TIFF file of two pages, the gain and the dark field."""
        with tifffile.TiffWriter(file) as tiff:
            for plane in (self.gain, np.broadcast_to(self.dark, self.gain.shape)):
                tiff.write(
                    np.ascontiguousarray(plane.squeeze()), compression="zlib", metadata=None, software="rdstitch"
                )


def read_flat_field(file: str | Path, size: tuple[int, int], channels: int) -> FlatField:
    """The flat field of an image file, and the dark field where it has a second page."""
    path = Path(file)
    check_readable(path)
    with decoding(path), tifffile.TiffFile(path) as tiff:
        pages = [np.asarray(page.asarray(), dtype=np.float32) for page in islice(image_pages(tiff), 2)]
    planes = [page.reshape(*page.shape[:2], -1) for page in pages]
    for number, plane in enumerate(planes, 1):
        height, width, bands = plane.shape
        if (width, height) != size:
            has = f"page {number} has {width} x {height} pixels"
            raise InputError(f"{file}: {has}, but the tiles {size[0]} x {size[1]}")
        if bands not in (1, channels):
            raise InputError(f"{file}: page {number} has {bands} channels, but the tiles {channels}")
        if not np.isfinite(plane).all():
            raise InputError(f"{file}: page {number} has values that are not finite")
    gain = planes[0]
    if not (gain > 0).all():
        raise InputError(f"{file}: a flat field must be positive everywhere")
    dark = planes[1] if len(planes) > 1 else np.zeros((1, 1, gain.shape[2]), dtype=np.float32)
    return FlatField(gain / gain.mean(axis=(0, 1)), dark)
