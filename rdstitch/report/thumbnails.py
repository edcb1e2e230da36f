"""Small pictures inside the page, as data addresses."""

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from rdstitch.errors import InputError
from rdstitch.inputs.source import Source
from rdstitch.io.deepzoom import read_deep_zoom
from rdstitch.io.read import read_image
from rdstitch.io.reduction import fitting_reduction
from rdstitch.stitch_result import StitchResult

_JPEG_QUALITY = 80
_LARGE = 60_000_000  # px; of larger TIFF files an overview is read


def of_source(source: Source, side: int) -> str | None:
    """A thumbnail of an input picture; None where it is gone, as frames of videos are."""
    try:
        reduction = fitting_reduction(max(source.camera.image_size) / (2 * side))
        return data_address(source.read(reduction).pixels, side)
    except InputError:
        return None


def of_mosaic(result: StitchResult, side: int) -> str | None:
    """A thumbnail of the output; None where there is none, as after a dry run."""
    if result.composite is not None:
        return data_address(result.composite.pixels, side)
    if result.output is None or not result.output.exists():
        return None
    width, height = result.canvas.size
    if result.output.suffix.lower() == ".dzi":
        return data_address(read_deep_zoom(result.output, (width, height), side), side)
    if width * height > _LARGE and result.output.suffix.lower() in (".tif", ".tiff"):
        return data_address(_overview(result.output, side), side)
    return data_address(read_image(result.output).pixels, side)


def data_address(pixels: NDArray[Any], side: int) -> str:
    """A picture of any sample type as JPEG inside a ``data:`` address, its longer side at most so many px."""
    # Far too large pictures are thinned out before they are smoothed.
    step = max(1, max(pixels.shape[:2]) // (4 * side))
    image = Image.fromarray(_as_bytes(pixels[::step, ::step]))
    image.thumbnail((side, side))
    stream = io.BytesIO()
    image.save(stream, "JPEG", quality=_JPEG_QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def _as_bytes(pixels: NDArray[Any]) -> NDArray[np.uint8]:
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


def _overview(path: Path, side: int) -> NDArray[Any]:
    """The smallest overview of a TIFF file that is large enough."""
    with tifffile.TiffFile(path) as file:
        levels = file.series[0].levels
        enough = [level for level in levels if max(level.shape[:2]) >= side]
        return np.asarray((enough or levels)[-1 if enough else 0].asarray())
