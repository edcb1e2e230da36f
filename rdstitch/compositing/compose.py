"""The compositor: pictures, cameras and homographies in, one picture out."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.camera import Camera
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.options import CompositeOptions
from rdstitch.compositing.pictures import PictureCache, Source
from rdstitch.compositing.warp import Box, Warp, plan_warp, warp_tile
from rdstitch.errors import ArgumentError

# Called with the share of the work done, 0 to 1.
Progress = Callable[[float], None]

_DEFAULT_MEMORY = 2**30


@dataclass(frozen=True)
class Composite:
    """The stitched picture.

    Attributes
    ----------
    pixels : ndarray of shape (H, W) or (H, W, C)
        In the sample type of the pictures, RGB order; 0 where no picture lies.
    alpha : ndarray of shape (H, W), uint8
        255 where a picture lies, else 0.
    canvas : Canvas
        Geometry of ``pixels``, after cropping.
    """

    pixels: NDArray[Any]
    alpha: NDArray[np.uint8]
    canvas: Canvas


def compose(
    sources: Sequence[Source],
    cameras: Sequence[Camera],
    homographies: ArrayLike,
    canvas: Canvas,
    options: CompositeOptions | None = None,
    progress: Progress | None = None,
) -> Composite:
    """Put pictures together on a canvas.

    Parameters
    ----------
    sources : sequence of callables
        Each reads one picture (:func:`rdstitch.io.read_image`); called when its tiles come, perhaps again later.
    cameras : sequence of Camera
    homographies : array_like of shape (N, 3, 3)
        Normalized undistorted coordinates of each picture to plane coordinates.
    canvas : Canvas
        From :func:`rdstitch.compositing.plan_canvas` with the same cameras and homographies.
    options : CompositeOptions, optional
    progress : callable, optional
        Told the share of the work done, 0 to 1.

    Returns
    -------
    Composite

    Raises
    ------
    ArgumentError
        When the arguments do not fit together.
    InputError
        When a picture cannot be read.
    """
    options = options or CompositeOptions()
    matrices = np.asarray(homographies, dtype=np.float64)
    if not len(sources) == len(cameras) == len(matrices) == len(canvas.footprints):
        raise ArgumentError("sources, cameras, homographies and footprints must be equally many")
    warps = [plan_warp(c, g, canvas, k) for k, (c, g) in enumerate(zip(cameras, matrices, strict=True))]
    cache = PictureCache(
        sources,
        [c.image_size for c in cameras],
        [w.shrink for w in warps],
        options.max_memory or _DEFAULT_MEMORY,
    )
    first = cache[0].pixels
    width, height = canvas.size
    pixels = np.zeros((height, width, *first.shape[2:]), dtype=first.dtype)
    alpha = np.zeros((height, width), dtype=np.uint8)
    tiles = list(_tiles(canvas.size, options.tile_size))
    for done, box in enumerate(tiles, start=1):
        x0, y0, x1, y1 = box
        samples, covered = _feather(warps, cache, box, options)
        if samples is not None:
            pixels[y0:y1, x0:x1] = samples
            alpha[y0:y1, x0:x1] = np.where(covered, np.uint8(255), np.uint8(0))
        if progress is not None:
            progress(done / len(tiles))
    return Composite(pixels, alpha, canvas)


def _tiles(size: tuple[int, int], side: int) -> Iterator[Box]:
    """Boxes that cover the canvas, row by row."""
    width, height = size
    for y in range(0, height, side):
        for x in range(0, width, side):
            yield x, y, min(x + side, width), min(y + side, height)


def _feather(
    warps: Sequence[Warp], cache: PictureCache, box: Box, options: CompositeOptions
) -> tuple[NDArray[Any] | None, NDArray[np.bool_]]:
    """Mean of the pictures on one box, weighted by the distance to their borders."""
    x0, y0, x1, y1 = box
    total, weights = None, np.zeros((y1 - y0, x1 - x0), dtype=np.float32)
    dtype: np.dtype[Any] = np.dtype(np.uint8)
    for k, warp in enumerate(warps):
        bx0, by0, bx1, by1 = warp.box
        if bx0 >= x1 or bx1 <= x0 or by0 >= y1 or by1 <= y0:
            continue
        tile = warp_tile(warp, cache[k], box, options.interpolation)
        if tile is None:
            continue
        dtype = tile.pixels.dtype
        values = tile.pixels.astype(np.float32)
        if total is None:
            total = np.zeros_like(values)
        # Never 0 inside: a border pixel that one picture alone covers must not get lost.
        weight = np.where(tile.inside, np.maximum(tile.weight, np.float32(1e-6)), np.float32(0.0))
        total += values * (weight[..., None] if values.ndim == 3 else weight)
        weights += weight
    covered = weights > 0
    if total is None:
        return None, covered
    safe = np.where(covered, weights, np.float32(1.0))
    mean = total / (safe[..., None] if total.ndim == 3 else safe)
    if np.issubdtype(dtype, np.integer):
        mean = np.clip(np.rint(mean), 0, np.iinfo(dtype).max)
    return mean.astype(dtype), covered
