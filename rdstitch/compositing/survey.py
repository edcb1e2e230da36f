"""All images on a reduced canvas: what exposure, seams and cropping are decided on, and seams are looked at."""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from rdstitch.arrays import AnyArray, BoolArray, Float32Array, Int32Array, IntArray
from rdstitch.compositing.boxes import Box, cut, intersection, overlapping_pairs
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.likeness import likeness
from rdstitch.compositing.resample import sample, sample_opacity
from rdstitch.compositing.seam_quality import DIAGONAL, SeamQuality, SeamTile, measure_seams
from rdstitch.compositing.source_images import ImageReader, LoadedImage, PlacedImage
from rdstitch.compositing.warp import Warp, locate, plan_warps
from rdstitch.io.reduction import mean_of_channels

_MAX_IMAGE = 200_000  # pixels of one image on the reduced canvas; OpenCV finds seams at 100,000
_MAX_TOTAL = 16_000_000  # pixels of all images there
_MAX_SEEN = 24_000_000  # pixels of all images where their seams are looked at


@dataclass(frozen=True, eq=False)
class SurveyTile:
    """One image on the reduced canvas."""

    box: Box  # on the reduced canvas
    pixels: AnyArray  # (h, w, C): in the image's sample type
    inside: BoolArray  # (h, w), bool
    opacity: Float32Array | None = None  # (h, w), float32: of an image with a mask
    seam_tile: SeamTile | None = None  # the same, larger, where seams are looked at


@dataclass(frozen=True)
class Survey:
    """All images, small."""

    factor: int  # canvas pixels per reduced pixel, a power of two
    canvas: Canvas  # the reduced canvas
    warps: tuple[Warp, ...]  # onto the reduced canvas
    tiles: tuple[SurveyTile | None, ...]  # None for an image that is nowhere opaque
    enlarged: float  # pixels of what seams are looked at on for one of the reduced canvas, along a side

    def pairs(self) -> IntArray:
        """Pairs (P, 2) of images that lie over each other; see :func:`overlapping_pairs`."""
        return overlapping_pairs([None if tile is None else tile.box for tile in self.tiles])

    def overlap(self, i: int, j: int) -> tuple[Box, BoolArray]:
        """The box that the tiles of one of the pairs have in common, and where both images show in it."""
        a, b = self.tiles[i], self.tiles[j]
        assert a is not None
        assert b is not None
        box = intersection(a.box, b.box)
        assert box is not None
        return box, cut(a.inside, a.box, box) & cut(b.inside, b.box, box)

    def seam_quality(self, labels: Int32Array) -> SeamQuality:
        """What seams are like, in canvas pixels; ``labels`` are the owners of the reduced canvas."""
        full = 255.0
        shown = [tile for tile in self.tiles if tile is not None]
        if shown and shown[0].pixels.dtype != np.uint8:  # any part of the range may be what such images use
            low, high = np.mean([np.quantile(t.pixels[t.inside], [0.005, 0.995]) for t in shown], axis=0)
            full = max(float(high - low), 1e-12)
        seam_tiles = [None if tile is None else tile.seam_tile for tile in self.tiles]
        quality = measure_seams(seam_tiles, labels, self.enlarged, self.factor / self.enlarged, full)
        return replace(quality, **likeness(seam_tiles, self.pairs(), full)._asdict())


def survey_factor(canvas: Canvas) -> int:
    """Reduction at which all images together fit easily into memory, a power of two."""
    areas = canvas.areas()
    factor = 1
    while max(areas) > _MAX_IMAGE * factor**2 or sum(areas) > _MAX_TOTAL * factor**2:
        factor *= 2
    return factor


def survey_images(reader: ImageReader, images: Sequence[PlacedImage], canvas: Canvas, workers: int = 1) -> Survey:
    """Read every image once, ``workers`` at a time, and lay it, small, on the reduced canvas."""
    factor = survey_factor(canvas)
    small = canvas.reduced(factor)
    warps = tuple(plan_warps(images, small))
    enlarged = factor / seen_reduction(canvas, [warp.shrink / factor for warp in warps])
    with ThreadPoolExecutor(workers) as pool:
        tiles = tuple(pool.map(partial(_survey_tile, reader, enlarged), range(len(warps)), warps))
    return Survey(factor, small, warps, tiles, enlarged)


def seen_reduction(canvas: Canvas, shrinks: Sequence[float]) -> float:
    """Canvas pixels, along a side, for one of what seams are looked at on, by image pixels for one of the canvas.

    What is seen is the same for an output of any size: it decides what is shown.
    """
    areas = np.array(canvas.areas(), dtype=np.float64)
    usual = 1.44 * math.sqrt(float(np.median(areas)))  # the diagonal of an image of 4 to 3
    return max(1.0 / float(np.median(shrinks)), usual / DIAGONAL, math.sqrt(areas.sum() / _MAX_SEEN))


def _survey_tile(reader: ImageReader, enlarged: float, index: int, warp: Warp) -> SurveyTile | None:
    geometry = locate(warp, warp.box)
    finer = warp.enlarged(enlarged)
    image, larger = reader.prepared_twice(index, warp.shrink, finer.shrink)
    inside, opacity = geometry.inside, sample_opacity(image, geometry)
    if opacity is not None:
        inside = inside & (opacity > 0)
    if not inside.any():
        return None
    pixels = sample(image, geometry, "linear")
    # An image across the edge of a full turn has the whole width, and most of that is empty.
    columns = np.flatnonzero(inside.any(axis=0))
    widest = max(np.split(columns, np.flatnonzero(np.diff(columns) > 1) + 1), key=len)
    part = replace(
        warp, box=(warp.box[0] + int(widest[0]), warp.box[1], warp.box[0] + int(widest[-1]) + 1, warp.box[3])
    )
    return SurveyTile(
        warp.box, pixels.reshape(*inside.shape, -1), inside, opacity, _seam_tile(larger, part.enlarged(enlarged))
    )


def _seam_tile(image: LoadedImage, warp: Warp) -> SeamTile:
    """An image, grey, as its seams are looked at."""
    geometry = locate(warp, warp.box)
    inside, opacity = geometry.inside, sample_opacity(image, geometry)
    grey = mean_of_channels(sample(image, geometry, "linear").astype(np.float32))
    grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.0), dtype=np.float32)
    if image.pixels.dtype == np.uint8:
        grey = np.rint(grey).astype(np.uint8)  # a quarter of the memory
    return SeamTile(warp.box, grey, inside if opacity is None else inside & (opacity > 0))
