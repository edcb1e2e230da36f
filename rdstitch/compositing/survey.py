"""All images on a reduced canvas: what exposure and seams are decided on."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.compositing.boxes import Box, Float32Array, cut, intersection, overlapping_pairs
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.placed_image import PlacedImage
from rdstitch.compositing.sampling import sample, sample_opacity
from rdstitch.compositing.source_images import ImageReader
from rdstitch.compositing.warp import Warp, locate, plan_warps
from rdstitch.progress import ShareProgress, unheard

_MAX_IMAGE = 200_000
_MAX_TOTAL = 16_000_000  # pixels of one image and of all on the reduced canvas; OpenCV finds seams at 100,000


@dataclass(frozen=True)
class SurveyTile:
    """One image on the reduced canvas."""

    box: Box  # on the reduced canvas
    pixels: NDArray[Any]  # (h, w, C): in the image's sample type
    inside: NDArray[np.bool_]  # (h, w), bool
    opacity: Float32Array | None = None  # (h, w), float32: of an image with a mask


@dataclass(frozen=True)
class Survey:
    """All images, small."""

    factor: int  # canvas pixels per reduced pixel, a power of two
    canvas: Canvas  # the reduced canvas
    warps: tuple[Warp, ...]  # onto the reduced canvas
    tiles: tuple[SurveyTile | None, ...]  # None for an image that is nowhere opaque

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


def survey_factor(canvas: Canvas) -> int:
    """Reduction at which all images together fit easily into memory, a power of two."""
    areas = canvas.areas()
    factor = 1
    while max(areas) > _MAX_IMAGE * factor**2 or sum(areas) > _MAX_TOTAL * factor**2:
        factor *= 2
    return factor


def survey_images(
    reader: ImageReader,
    images: Sequence[PlacedImage],
    canvas: Canvas,
    workers: int = 1,
    progress: ShareProgress = unheard,
) -> Survey:
    """Read every image once, ``workers`` at a time, and lay it, small, on the reduced canvas."""
    factor = survey_factor(canvas)
    small = canvas.reduced(factor)
    warps = tuple(plan_warps(images, small))
    tiles = []
    with ThreadPoolExecutor(workers) as pool:
        for tile in pool.map(partial(_survey_tile, reader), range(len(warps)), warps):
            tiles.append(tile)
            progress(len(tiles) / len(warps))
    return Survey(factor, small, warps, tuple(tiles))


def _survey_tile(reader: ImageReader, index: int, warp: Warp) -> SurveyTile | None:
    """One image, small."""
    geometry = locate(warp, warp.box)
    image = reader.prepared(index, warp.shrink)
    inside, opacity = geometry.inside, sample_opacity(image, geometry)
    if opacity is not None:
        inside = inside & (opacity > 0)
    if not inside.any():
        return None
    pixels = sample(image, geometry, "linear")
    return SurveyTile(warp.box, pixels.reshape(*inside.shape, -1), inside, opacity)
