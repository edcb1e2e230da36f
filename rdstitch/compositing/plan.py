"""What a composite will take: memory and time, found before the work, and the sizes that follow from a memory limit."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rdstitch.compositing.blender import margin
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.transparency import OPACITY_BYTES
from rdstitch.errors import ArgumentError, LimitError
from rdstitch.geometry.camera import Camera
from rdstitch.options.composite_options import CompositeOptions
from rdstitch.system.machine import available_memory, processor_count

_SHARE = 0.25  # of the memory that is available
_LEAST = 400 * 2**20  # bytes that are taken in any case
_TILE_SIZES = (512, 256)
_MAX_WORKERS = 4
_MAX_BANDS = 4
# Arrays of float32 of the size of a tile with its margin that live at one time.
_LIVE_PER_CHANNEL = 5.0  # samples and sums of the pyramids
_LIVE_PLANES = 12.0  # coordinates, weights, owners
_LIVE_STRIPS = 4.5  # strips of the output, in its samples
# For an estimate only, on one core of a machine of 2020.
_SECONDS_OUT = 0.15  # per megapixel of output
_SECONDS_IN = 0.03  # per megapixel of input


@dataclass(frozen=True)
class CompositePlan:
    """Sizes of the work."""

    canvas_size: tuple[int, int]  # pixels, before cropping
    images: int
    tile_size: int  # pixels
    workers: int  # tiles at one time
    bands: int
    cache_bytes: int  # for images held
    memory_bytes: int  # estimate of all that the compositor holds at one time
    output_bytes: int  # of the samples, not compressed
    seconds: float  # rough estimate


def plan_composite(
    cameras: Sequence[Camera],
    canvas: Canvas,
    options: CompositeOptions,
    channels: int = 3,
    itemsize: int = 1,
    *,
    masked: bool = False,
) -> CompositePlan:
    """Tile size and cache that keep within the memory limit, with estimates for a dry run.

    ``masked``: some images have transparent parts.
    """
    if len(cameras) != len(canvas.footprints):
        raise ArgumentError(f"the canvas is for {len(canvas.footprints)} images, not for {len(cameras)}")
    bands = options.bands or usual_bands(cameras)
    limit = options.max_memory or default_memory()
    opacity = OPACITY_BYTES if masked or any(part is not None for part in canvas.near) else 0
    image = max(c.image_size[0] * c.image_size[1] for c in cameras) * (channels * itemsize + opacity)
    # While an image is decoded it is there twice, beside those in the cache.
    workers = options.workers or min(_MAX_WORKERS, processor_count())
    sides = _TILE_SIZES if options.tile_size is None else (options.tile_size,)
    choices = [(side, count) for side in sides for count in range(workers, 0, -1)]
    needs = {
        choice: 2 * image + _working_set(canvas, *choice, bands, options, channels, itemsize) for choice in choices
    }
    least = min(needs, key=lambda choice: needs[choice])
    if options.max_memory is not None and needs[least] > limit:
        raise LimitError(
            f"{limit / 2**20:.0f} MB are too little: this canvas needs {needs[least] / 2**20:.0f} MB; "
            "raise --max-memory or use a smaller --scale"
        )
    chosen = next((choice for choice in choices if needs[choice] + image <= limit), least)
    cache = max(image, limit - needs[chosen])
    width, height = canvas.size
    megapixels_in = sum(c.image_size[0] * c.image_size[1] for c in cameras) / 1e6
    return CompositePlan(
        canvas.size,
        len(cameras),
        *chosen,
        bands,
        cache,
        needs[chosen] + min(cache, image * len(cameras)),
        width * height * (channels * itemsize + 1),
        _SECONDS_OUT * width * height / 1e6 + _SECONDS_IN * megapixels_in,
    )


def default_memory() -> int:
    """Bytes that the compositor takes at most where the user gives no limit: a share of what is available now."""
    return max(_LEAST, int(_SHARE * available_memory()))


def usual_bands(cameras: Sequence[Camera]) -> int:
    """Bands that suit the smallest image: the widest transition is a few per cent of its side."""
    side = min(min(c.image_size) for c in cameras)
    return int(np.clip(np.log2(max(side, 1)) - 4.5, 1, _MAX_BANDS))


def _working_set(
    canvas: Canvas, side: int, workers: int, bands: int, options: CompositeOptions, channels: int, itemsize: int
) -> int:
    """Bytes of the tiles at work, and of strips: two are filled, and a third is written with its overviews."""
    outer = side + 2 * (margin(bands) if options.blend == "multiband" else 0)
    tile = 4.0 * outer**2 * (_LIVE_PER_CHANNEL * channels + _LIVE_PLANES)
    strips = _LIVE_STRIPS * canvas.size[0] * min(side, canvas.size[1]) * (channels * itemsize + 1)
    return int(workers * tile + strips)
