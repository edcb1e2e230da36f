"""Small versions of images, for pages and notebooks."""

import io
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image, JpegImagePlugin

from rdstitch.arrays import AnyArray, UInt8Array
from rdstitch.io.deepzoom import read_deep_zoom
from rdstitch.io.read import read_image
from rdstitch.system.late_imports import tifffile

_JPEG_QUALITY = 80
_OVERVIEW_FROM = 60_000_000  # pixels; of larger TIFF files the smallest overview that is large enough is read


def read_preview(path: Path, size: tuple[int, int], side: int) -> tuple[AnyArray, UInt8Array | None]:
    """Samples and alpha of an image that rdstitch wrote, at least ``side`` pixels long where it is that large."""
    suffix = path.suffix.lower()
    if suffix == ".dzi":
        return read_deep_zoom(path, size, side), None
    if size[0] * size[1] > _OVERVIEW_FROM and suffix in (".tif", ".tiff"):
        with tifffile.TiffFile(path) as file:
            large, *overviews = file.series[0].levels
            enough = [level for level in overviews if max(level.sizes["height"], level.sizes["width"]) >= side]
            level = enough[-1] if enough else large
            pixels = level.asarray()
            return (np.moveaxis(pixels, 0, -1) if level.axes == "CYX" else pixels), None
    if suffix in (".jpg", ".jpeg"):
        # Of any size: none of it is decoded larger than needed.
        with JpegImagePlugin.JpegImageFile(path) as jpeg:
            jpeg.draft(None, (side, side))
            return np.asarray(jpeg), None
    image = read_image(path)
    return image.pixels, image.alpha


def encode_preview(
    pixels: AnyArray, side: int, alpha: UInt8Array | None = None, kind: Literal["JPEG", "PNG"] = "JPEG"
) -> bytes:
    """An image of any sample type as a small file, its longer side at most ``side`` pixels."""
    # Far too large images are thinned out before they are smoothed.
    step = max(1, max(pixels.shape[:2]) // (4 * side))
    image = Image.fromarray(_as_bytes(pixels[::step, ::step]))
    if alpha is not None:
        image.putalpha(Image.fromarray(np.ascontiguousarray(alpha[::step, ::step])))
    image.thumbnail((side, side))
    stream = io.BytesIO()
    image.save(stream, kind, **({"quality": _JPEG_QUALITY} if kind == "JPEG" else {}))
    return stream.getvalue()


def _as_bytes(pixels: AnyArray) -> UInt8Array:
    """Grey or RGB in 8 bits; deeper samples are stretched between their extremes."""
    shown = pixels if pixels.ndim == 2 else pixels[..., :3]
    if shown.ndim == 3 and shown.shape[2] < 3:
        shown = shown[..., 0]
    if shown.dtype == np.uint8:
        return np.ascontiguousarray(shown)
    values = shown.astype(np.float32)
    low, high = np.percentile(values, [0.5, 99.5])
    stretched = (values - low) * (255.0 / max(float(high - low), 1e-12))
    return np.asarray(np.clip(stretched, 0.0, 255.0), dtype=np.uint8)
