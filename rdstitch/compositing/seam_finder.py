"""Seams: which image each pixel of the output comes from, decided on the reduced canvas.

"voronoi": where the borders of two images are equally far, so that each image gives its middle. "graphcut": round
that line, within a wide band, along the path on which the two images differ least (Kwatra et al. 2003, with OpenCV's
cut), so that what moved or stands out of the plane is taken from one of them whole. Images are added one after the
other, so that memory is that of one label per pixel of the reduced canvas.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from rdstitch.arrays import AnyArray, BoolArray, Float32Array, Int32Array, UInt8Array
from rdstitch.compositing.boxes import Box
from rdstitch.compositing.photometric import Exposure, full_scale
from rdstitch.compositing.resample import border_weight
from rdstitch.compositing.survey import Survey, SurveyTile
from rdstitch.compositing.warp import locate
from rdstitch.io.reduction import block_mean
from rdstitch.system.ahead import in_order_ahead

NO_OWNER = -1

# Band in which a seam may wander, by the new image's share of both border weights.
_MIN_WEIGHT = 0.1
_MAX_WEIGHT = 0.9
# Difference of brightness, share of the full range, that the edges of that band count as: where nothing differs, a seam
# keeps to the middle, and what moves is gone round on either side.
_ASIDE = 0.04
_AROUND_FREE = 2  # pixels around the free ones that a cut sees
_AHEAD = 4  # images that are prepared before their cuts
_EDGES = 2.0  # what a difference of edges, a pixel, counts beside one of brightness
# Root of the largest cost of a pixel, in that of the length of a seam; OpenCV's cut keeps to what it must separate up
# to a cost of 10,000.
_VISIBLE = 64.0
_MAX_CUT = 15_000  # pixels: a larger cut is found at half the size first
_MOVED = 3  # pixels by which it may then move


@dataclass(frozen=True, eq=False)
class SeamMap:
    """Owner of each pixel of the reduced canvas."""

    labels: Int32Array  # (h, w), int32: index of the image, or -1 where there is none
    factor: int  # canvas pixels per reduced pixel, even or 1
    # shares pass from one owner to the next over so many reduced pixels on either side of a seam, for feathering
    softness: int = 0
    origin: tuple[int, int] = (0, 0)  # where ``labels`` begin on the reduced canvas: x, y

    def owners(self, box: Box) -> list[int]:
        """Images that own anything on a box (canvas pixels), ascending; -1 first where a part has no owner."""
        return [int(owner) for owner in np.unique(self._window(box))]

    def weights(self, owner: int, box: Box) -> Float32Array:
        """How much of each pixel of a box (canvas pixels) an image owns: labels interpolated linearly, (h, w).

        Every value depends on the labels around it alone, bit for bit, whatever the box: sums of ones and of shares of
        an even number of pixels are exact.
        """
        owned = (self._window(box) == owner).astype(np.float32)
        if owned.all():
            return np.ones((box[3] - box[1], box[2] - box[0]), dtype=np.float32)
        side = 2 * self.softness + 1
        if side > 1:
            owned = cv2.boxFilter(owned, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
        size = (owned.shape[1] * self.factor, owned.shape[0] * self.factor)
        weights = np.asarray(cv2.resize(owned, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
        x, y = (edge % self.factor + (1 + self.softness) * self.factor for edge in box[:2])
        weights = weights[y : y + box[3] - box[1], x : x + box[2] - box[0]]
        return weights * np.float32(1.0 / side**2)

    def repeated(self, period: int) -> "SeamMap":
        """The map of a canvas that goes all the way round, wider than a full turn of ``period`` canvas pixels.

        Both ends, where it shows the same again, have the owners of the middle.
        """
        turn = period // self.factor
        margin = (self.labels.shape[1] - turn) // 2
        return replace(self, labels=np.take(self.labels, np.arange(-margin, turn + margin) % turn + margin, axis=1))

    def part(self, box: Box, images: Sequence[int]) -> "SeamMap":
        """The map of a box (canvas pixels), of some of the images, numbered anew; nobody has what others own."""
        around = 1 + self.softness
        (left, right), (top, bottom) = (
            (max(0, start // self.factor - around - first), max(1, -(-stop // self.factor) + around - first))
            for start, stop, first in zip(box[:2], box[2:], self.origin, strict=True)
        )
        labels = self.labels[top:bottom, left:right]
        number = np.full(max(int(labels.max(initial=0)), *images, 0) + 2, NO_OWNER, dtype=np.int32)
        number[list(images)] = np.arange(len(images))
        return replace(self, labels=number[labels], origin=(self.origin[0] + left, self.origin[1] + top))

    def _window(self, box: Box) -> Int32Array:
        """The labels that affect a box, one and the softness more on each side; the border repeats itself."""
        around = 1 + self.softness
        columns, rows = (
            np.clip(np.arange(start // self.factor - around, -(-stop // self.factor) + around) - first, 0, count - 1)
            for start, stop, first, count in zip(box[:2], box[2:], self.origin, self.labels.shape[::-1], strict=True)
        )
        return self.labels[np.ix_(rows, columns)]


def find_seams(survey: Survey, exposure: Exposure, graphcut: bool, workers: int = 1) -> SeamMap:
    """Owner of every pixel.

    Seams avoid what differs but for exposure, or, without ``graphcut``, run where borders are equally far. One of
    several ``workers`` prepares the next images beside the cuts, which follow each other.
    """
    width, height = survey.canvas.size
    labels = np.full((height, width), NO_OWNER, dtype=np.int32)
    weights = np.zeros((height, width), dtype=np.float32)
    shown = next((tile.pixels for tile in survey.tiles if tile is not None), np.zeros((0, 0, 1), np.uint8))
    composite = np.zeros((height, width, shown.shape[2]), dtype=shown.dtype) if graphcut else None
    prepare = partial(_prepared, survey, exposure if graphcut else None)
    images = [index for index, tile in enumerate(survey.tiles) if tile is not None]
    with ThreadPoolExecutor(1) as pool:
        prepared = map(prepare, images) if workers == 1 else in_order_ahead(pool, prepare, images, _AHEAD)
        for index, (tile, weight, pixels) in zip(images, prepared, strict=True):
            x0, y0, x1, y1 = tile.box
            cut = np.s_[y0:y1, x0:x1]
            if composite is None or pixels is None:
                won = tile.inside & (weight > weights[cut])
            else:
                in_pieces = survey.canvas.period is not None
                shares = weight / np.maximum(weight + weights[cut], np.float32(1e-12))
                won = _cut(tile.inside, pixels, composite[cut], labels[cut] != NO_OWNER, shares, in_pieces=in_pieces)
                cv2.copyTo(pixels, won.view(np.uint8), composite[cut])
            labels[cut][won] = index
            weights[cut][won] = weight[won]
    return SeamMap(labels, survey.factor)


def _prepared(
    survey: Survey, exposure: Exposure | None, index: int
) -> tuple[SurveyTile, Float32Array, AnyArray | None]:
    """A tile with its border weights, and its samples as exposed alike, if they are wanted."""
    tile = survey.tiles[index]
    assert tile is not None
    geometry = locate(survey.warps[index], tile.box)
    weight = border_weight(geometry)
    if tile.opacity is not None:
        weight *= tile.opacity
    return tile, weight, None if exposure is None else exposure.correct(index, geometry, tile.pixels)


def _cut(
    inside: BoolArray,
    pixels: AnyArray,
    below: AnyArray,
    covered: BoolArray,
    weight_fraction: Float32Array,
    *,
    in_pieces: bool,
) -> BoolArray:
    """Where a new image, with its share of both border weights, replaces what lies below it.

    ``in_pieces``: in several places, one by one.
    """
    both = inside & covered
    alone: BoolArray = inside & ~covered
    free = both & (weight_fraction > _MIN_WEIGHT) & (weight_fraction < _MAX_WEIGHT)
    surely_new: BoolArray = alone | (both & (weight_fraction >= _MAX_WEIGHT))
    surely_old = covered & ~(surely_new | free)
    if not free.any():
        return surely_new
    if not surely_old.any():
        return np.asarray(surely_new | free)
    if not surely_new.any():
        return surely_new
    won = surely_new.copy()
    for part in _parts(free) if in_pieces else [_around(free)]:
        masks = [(free | sure)[part].astype(np.uint8) * np.uint8(255) for sure in (surely_old, surely_new)]
        won[part] |= free[part] & _graph_cut(_visibility(pixels[part], below[part], weight_fraction[part]), masks)
    return won


def _parts(free: BoolArray) -> list[tuple[slice, slice]]:
    """Where cuts are free to run, column by column: an image across the edge of a full turn has both ends."""
    columns = np.flatnonzero(free.any(axis=0))
    groups = np.split(columns, np.flatnonzero(np.diff(columns) > 2 * _AROUND_FREE + 1) + 1)
    parts = []
    for group in groups:
        rows, _ = _around(free[:, group[0] : group[-1] + 1])
        parts.append((rows, slice(max(0, int(group[0]) - _AROUND_FREE), int(group[-1]) + 1 + _AROUND_FREE)))
    return parts


def _around(free: BoolArray) -> tuple[slice, slice]:
    """The box in which a cut can run, with a margin that certainly belongs to either side."""
    rows, columns = (np.flatnonzero(free.any(axis=axis)) for axis in (1, 0))
    return (
        slice(max(0, int(rows[0]) - _AROUND_FREE), int(rows[-1]) + 1 + _AROUND_FREE),
        slice(max(0, int(columns[0]) - _AROUND_FREE), int(columns[-1]) + 1 + _AROUND_FREE),
    )


def _visibility(first: AnyArray, second: AnyArray, weight_fraction: Float32Array) -> Float32Array:
    """How much a seam shows at each pixel (h, w): the square of what two images differ by in brightness and in edges.

    One broken edge shows more than many small differences. ``weight_fraction``, the second image's of both border
    weights, says how far it is from the middle.
    """
    difference = first.astype(np.float32) - second
    # A product is much faster than a mean over a short axis.
    mean = np.full(first.shape[2], 1.0 / (first.shape[2] * full_scale(first.dtype)), dtype=np.float32)
    grey = difference @ mean
    edges = sum(np.abs(cv2.Sobel(grey, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=_EDGES / 8)) for dx in (1, 0))
    shown, aside = np.abs(difference) @ mean + edges, _ASIDE * (2.0 * weight_fraction - 1.0)
    return np.asarray(_VISIBLE**2 * np.minimum(shown**2 + aside**2, 1.0), dtype=np.float32)


def _graph_cut(cost: Float32Array, masks: list[UInt8Array]) -> BoolArray:
    """Where the second of two images wins; the pixels that one mask alone has are what the cut must separate.

    A large cut is found at half the size first, and then only moved by a few pixels. What the images differ by is
    averaged then, not the images: fine detail that is a little off would vanish from a smaller image, not from the cut.
    """
    if masks[0].size > _MAX_CUT:
        halved = np.asarray(block_mean(cost, 2), dtype=np.float32)
        masks = _near_cut(_graph_cut(halved, [mask[::2, ::2] for mask in masks]), masks)
    won = masks[1] > 0
    free = won & (masks[0] > 0)
    if not free.any():
        return won
    part = _around(free)
    # The type stubs lack the class, and a UMat made of an array.
    detail: Any = cv2
    finder = detail.detail_GraphCutSeamFinder("COST_COLOR")
    # Its cost is the squared distance of two colours.
    root = np.sqrt(cost[part])
    colours = [np.zeros((*root.shape, 3), dtype=np.float32), np.stack([root, root * 0, root * 0], axis=-1)]
    cut_images, cut_masks = (
        [detail.UMat(np.ascontiguousarray(a)) for a in both] for both in (colours, [m[part] for m in masks])
    )
    won[part] = finder.find(cut_images, [(0, 0), (0, 0)], cut_masks)[1].get() > 0
    return won


def _near_cut(won: BoolArray, masks: list[UInt8Array]) -> list[UInt8Array]:
    """Masks that leave free only what is near a cut found at half the size."""
    height, width = masks[0].shape
    above = np.repeat(np.repeat(won, 2, axis=0), 2, axis=1)[:height, :width].astype(np.uint8)
    kernel = np.ones((2 * _MOVED + 1,) * 2, np.uint8)
    surely_new, surely_old = cv2.erode(above, kernel) > 0, cv2.dilate(above, kernel) == 0
    free = (masks[0] > 0) & (masks[1] > 0)
    return [
        np.where(free & settled, np.uint8(0), mask)
        for mask, settled in zip(masks, (surely_new, surely_old), strict=True)
    ]
