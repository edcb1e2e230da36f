"""The compositor: pictures, cameras and homographies in, one picture out."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.camera import Camera
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.exposure import Exposure, estimate_exposure, no_exposure
from rdstitch.compositing.options import CompositeOptions
from rdstitch.compositing.pictures import PictureCache, PictureReader, Source
from rdstitch.compositing.render import Renderer
from rdstitch.compositing.seams import find_seams
from rdstitch.compositing.survey import survey_pictures
from rdstitch.compositing.warp import plan_warp
from rdstitch.errors import ArgumentError

# Called with the share of the work done, 0 to 1.
Progress = Callable[[float], None]

_DEFAULT_MEMORY = 2**30
_MOST_BANDS = 5


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
    exposure : Exposure
        What the pictures were corrected by.
    """

    pixels: NDArray[Any]
    alpha: NDArray[np.uint8]
    canvas: Canvas
    exposure: Exposure


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
    renderer = prepare(sources, cameras, homographies, canvas, options, _part_of(progress, 0.0, 0.3))
    width, height = canvas.size
    # Held in BGR order, so that encoders that want it need no copy; seen in RGB order.
    pixels = np.zeros((height, width, renderer.channels), dtype=renderer.dtype)[..., ::-1]
    alpha = np.zeros((height, width), dtype=np.uint8)
    for top, samples, covered in strips(renderer, canvas, _part_of(progress, 0.3, 1.0)):
        pixels[top : top + len(samples)] = samples
        alpha[top : top + len(samples)] = covered
    return Composite(pixels if renderer.channels > 1 else pixels[..., 0], alpha, canvas, renderer.exposure)


def prepare(
    sources: Sequence[Source],
    cameras: Sequence[Camera],
    homographies: ArrayLike,
    canvas: Canvas,
    options: CompositeOptions,
    progress: Progress | None = None,
) -> Renderer:
    """Decide on exposure and seams, from one small look at each picture; parameters as for :func:`compose`."""
    matrices = np.asarray(homographies, dtype=np.float64)
    if not len(sources) == len(cameras) == len(matrices) == len(canvas.footprints):
        raise ArgumentError("sources, cameras, homographies and footprints must be equally many")
    warps = [plan_warp(c, g, canvas, k) for k, (c, g) in enumerate(zip(cameras, matrices, strict=True))]
    reader = PictureReader(sources, [c.image_size for c in cameras])
    exposure, seams = None, None
    if options.exposure != "none" or options.seam != "none":
        survey = survey_pictures(reader, cameras, matrices, canvas, _part_of(progress, 0.0, 0.7))
        if options.exposure != "none":
            exposure = estimate_exposure(survey, cameras, blocks=options.exposure == "blocks")
        if options.seam != "none":
            decided = exposure or no_exposure(len(cameras), reader.samples[0])
            graphcut = options.seam == "graphcut"
            seams = find_seams(survey, decided, graphcut, _part_of(progress, 0.7, 1.0))
    channels, dtype = reader.samples
    return Renderer(
        warps,
        PictureCache(reader, [w.shrink for w in warps], options.max_memory or _DEFAULT_MEMORY),
        exposure or no_exposure(len(cameras), channels),
        seams,
        options,
        options.bands or _bands(cameras),
        channels,
        dtype,
    )


def strips(
    renderer: Renderer, canvas: Canvas, progress: Progress | None = None
) -> Iterator[tuple[int, NDArray[Any], NDArray[np.uint8]]]:
    """The output from top to bottom: first row, samples (h, W, C) and alpha (h, W) of each strip of tiles."""
    width, height = canvas.size
    side = renderer.options.tile_size
    for top in range(0, height, side):
        bottom = min(top + side, height)
        samples = np.zeros((bottom - top, width, renderer.channels), dtype=renderer.dtype)
        alpha = np.zeros((bottom - top, width), dtype=np.uint8)
        for left in range(0, width, side):
            right = min(left + side, width)
            samples[:, left:right], covered = renderer.tile((left, top, right, bottom))
            alpha[:, left:right][covered] = 255
            if progress is not None:
                progress((top * width + (bottom - top) * right) / (width * height))
        yield top, samples, alpha


def _bands(cameras: Sequence[Camera]) -> int:
    """Bands that suit the smallest picture: the widest transition is a few per cent of its side."""
    side = min(min(c.image_size) for c in cameras)
    return int(np.clip(math.log2(max(side, 1)) - 4.5, 1, _MOST_BANDS))


def _part_of(progress: Progress | None, start: float, stop: float) -> Progress | None:
    """A progress that fills a part of another."""
    if progress is None:
        return None
    return lambda share: progress(start + (stop - start) * share)
