"""All images on a reduced canvas: what exposure, seams and cropping are decided on, and seams are looked at."""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.compositing.boxes import Box, Float32Array, cut, intersection, overlapping_pairs
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.seam_quality import DIAGONAL, SeamQuality, SeamTile, likeness, measure_seams
from rdstitch.compositing.source_images import ImageReader, LoadedImage, PlacedImage
from rdstitch.compositing.warp import Warp, locate, plan_warps, sample, sample_opacity
from rdstitch.io.reduction import mean_of_channels

_MAX_IMAGE = 200_000
_MAX_TOTAL = 16_000_000  # pixels of one image and of all on the reduced canvas; OpenCV finds seams at 100,000
_MAX_SEEN = 24_000_000  # pixels of all images where their seams are looked at


@dataclass(frozen=True, eq=False)
class SurveyTile:
    """One image on the reduced canvas."""

    box: Box  # on the reduced canvas
    pixels: NDArray[Any]  # (h, w, C): in the image's sample type
    inside: NDArray[np.bool_]  # (h, w), bool
    opacity: Float32Array | None = None  # (h, w), float32: of an image with a mask
    seen: SeamTile | None = None  # the same, larger, where seams are looked at


@dataclass(frozen=True)
class Survey:
    """All images, small."""

    factor: int  # canvas pixels per reduced pixel, a power of two
    canvas: Canvas  # the reduced canvas
    warps: tuple[Warp, ...]  # onto the reduced canvas
    tiles: tuple[SurveyTile | None, ...]  # None for an image that is nowhere opaque
    enlarged: float  # pixels of what seams are looked at on for one of the reduced canvas, along a side

    def pairs(self) -> NDArray[np.intp]:
        """Pairs (P, 2) of images that lie over each other; see :func:`overlapping_pairs`."""
        return overlapping_pairs([None if tile is None else tile.box for tile in self.tiles])

    def overlap(self, i: int, j: int) -> tuple[SurveyTile, SurveyTile, Box, NDArray[np.bool_]]:
        """The tiles of one of the pairs, the box that they have in common, and where both images show in it."""
        a, b = self.tiles[i], self.tiles[j]
        assert a is not None
        assert b is not None
        box = intersection(a.box, b.box)
        assert box is not None
        return a, b, box, cut(a.inside, a.box, box) & cut(b.inside, b.box, box)

    def seam_quality(self, labels: NDArray[np.int32]) -> SeamQuality:
        """What seams are like, in canvas pixels; ``labels`` are the owners of the reduced canvas."""
        full = 255.0
        shown = [tile for tile in self.tiles if tile is not None]
        if shown and shown[0].pixels.dtype != np.uint8:  # any part of the range may be what such images use
            low, high = np.mean([np.quantile(t.pixels[t.inside], [0.005, 0.995]) for t in shown], axis=0)
            full = max(float(high - low), 1e-12)
        seen = [None if tile is None else tile.seen for tile in self.tiles]
        quality = measure_seams(seen, labels, self.enlarged, self.factor / self.enlarged, full)
        return replace(quality, **likeness(seen, self.pairs(), full)._asdict())


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
    """One image, small."""
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
        warp.box, pixels.reshape(*inside.shape, -1), inside, opacity, _seen(larger, part.enlarged(enlarged))
    )


def _seen(image: LoadedImage, warp: Warp) -> SeamTile:
    """An image, grey, as its seams are looked at."""
    geometry = locate(warp, warp.box)
    inside, opacity = geometry.inside, sample_opacity(image, geometry)
    grey = mean_of_channels(sample(image, geometry, "linear").astype(np.float32))
    grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.0), dtype=np.float32)
    if image.pixels.dtype == np.uint8:
        grey = np.rint(grey).astype(np.uint8)  # a quarter of the memory
    return SeamTile(warp.box, grey, inside if opacity is None else inside & (opacity > 0))


# Rectangles are sought with at most this many pixels along the longer side of the canvas.
_RESOLUTION = 1500
# A rectangle that keeps less of what is covered is not worth cropping to.
_MIN_KEPT = 0.25


def covered_pixels(survey: Survey) -> NDArray[np.bool_]:
    """Which pixels of the reduced canvas images cover."""
    covered = np.zeros(survey.canvas.size[::-1], dtype=np.bool_)
    for tile in survey.tiles:
        if tile is not None:
            cut(covered, (0, 0, *survey.canvas.size), tile.box)[...] |= tile.inside
    return covered


def crop_box(covered: NDArray[np.bool_], factor: int, size: tuple[int, int]) -> tuple[Box | None, str]:
    """Largest rectangle without holes, on the canvas, and, when there is none worth having, why.

    ``covered`` as of :func:`covered_pixels`, of which each takes ``factor`` pixels a side of a canvas of this size.
    """
    # A reduced pixel stands for those around its centre: one more on each side makes sure of all of them.
    whole = cv2.erode(
        covered.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=(0,)
    )
    coarse = max(1, -(-max(covered.shape) // _RESOLUTION))
    rows, columns = (n // coarse for n in whole.shape)
    cells = whole[: rows * coarse, : columns * coarse].reshape(rows, coarse, columns, coarse).min(axis=(1, 3)) > 0
    x0, y0, x1, y1 = largest_rectangle(cells)
    kept = (x1 - x0) * (y1 - y0) * coarse**2 / max(1, int(covered.sum()))
    if kept < _MIN_KEPT:
        return None, f"not cropped: the largest rectangle without holes would keep {100 * kept:.0f} % of the image"
    unit = coarse * factor
    return (x0 * unit, y0 * unit, min(x1 * unit, size[0]), min(y1 * unit, size[1])), ""


def crop_rows(covered: NDArray[np.bool_], factor: int, size: tuple[int, int], whole: Box) -> tuple[Box | None, str]:
    """As :func:`crop_box`, for a canvas that goes all the way round: rows without holes, at their full width.

    ``whole`` is one full turn of it.
    """
    columns = slice(-(-whole[0] // factor), whole[2] // factor)
    full = np.concatenate([[False], covered[:, columns].all(axis=1), [False]])
    edges = np.flatnonzero(full[1:] != full[:-1]).reshape(-1, 2)
    first, last = edges[np.argmax(np.diff(edges, axis=1))] if len(edges) else (0, 0)
    # A reduced pixel stands for those around its centre: one row less on each side makes sure of all of them.
    first, last = first + (first > 0), last - (last < len(covered))
    kept = (last - first) * covered.shape[1] / max(1, int(covered.sum()))
    if kept < _MIN_KEPT:
        return None, f"not cropped: the rows without holes would keep {max(0.0, 100 * kept):.0f} % of the image"
    return (whole[0], int(first) * factor, whole[2], min(int(last) * factor, size[1])), ""


def largest_rectangle(cells: NDArray[np.bool_]) -> Box:
    """Largest upright rectangle of true cells: x0, y0, x1, y1, end exclusive; empty where there is none.

    Row by row, the height of the column of true cells above each cell, and for each the widest run of columns at least
    as high, found with a stack.
    """
    heights = np.zeros(cells.shape[1] + 1, dtype=np.int64)
    best, area = (0, 0, 0, 0), 0
    for y, row in enumerate(cells):
        heights[:-1] = np.where(row, heights[:-1] + 1, 0)
        # Only where the column ends below can a rectangle be the largest; but a row's bound is cheap to test.
        if int(heights.max()) * cells.shape[1] <= area:
            continue
        stack: list[tuple[int, int]] = []
        for x, height in enumerate(heights.tolist()):
            start = x
            while stack and stack[-1][1] >= height:
                start, tall = stack.pop()
                if tall * (x - start) > area:
                    area = tall * (x - start)
                    best = (start, y + 1 - tall, x, y + 1)
            stack.append((start, height))
    return best
