"""Seams: which picture each px of the output comes from, decided on the reduced canvas.

"voronoi": where the borders of two pictures are equally far, so that each picture gives its middle. "graphcut": round
that line, within a band, along the path on which the two pictures differ least (Kwatra et al. 2003, with OpenCV's
cut), so that what moved or stands out of the plane is taken from one of them whole. Pictures are added one after the
other, so that memory is that of one label per px of the reduced canvas.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.compositing.exposure import Exposure, full_scale
from rdstitch.compositing.survey import Survey, SurveyTile
from rdstitch.compositing.warp import Box, Float32Array

NOBODY = -1

# Index before and after each px, and the share of the second.
_Neighbours = tuple[NDArray[np.intp], NDArray[np.intp], Float32Array]

# Band in which a seam may wander: the new picture's share of both border weights.
_LEAST_SHARE, _LARGEST_SHARE = 0.2, 0.8
_AROUND_FREE = 2


@dataclass(frozen=True)
class SeamMap:
    """Owner of each px of the reduced canvas.

    Attributes
    ----------
    labels : ndarray of shape (h, w), int32
        Index of the picture, or -1 where there is none.
    factor : int
        Canvas px per reduced px, even or 1.
    softness : int
        Shares pass from one owner to the next over so many reduced px on either side of a seam, for feathering.
    """

    labels: NDArray[np.int32]
    factor: int
    softness: int = 0

    def owners(self, box: Box) -> list[int]:
        """Pictures that own anything on a box (canvas px), ascending."""
        window = self._window(*self._neighbours(box))[0]
        return [int(owner) for owner in np.unique(window) if owner != NOBODY]

    def share(self, owner: int, box: Box) -> Float32Array:
        """How much of each px of a box (canvas px) a picture owns: labels interpolated linearly, (h, w).

        Every value depends on the labels around it alone, bit for bit, whatever the box.
        """
        x, y = self._neighbours(box)
        window, left, top = self._window(x, y)
        owned = (window == owner).astype(np.float32)
        if owned.all():
            return np.ones((len(y[0]), len(x[0])), dtype=np.float32)
        if self.softness:
            # Sums of ones are exact, in any order.
            side = 2 * self.softness + 1
            owned = cv2.boxFilter(owned, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
            owned *= np.float32(1.0 / side**2)
        rows = owned[y[0] - top] * (1 - y[2])[:, None] + owned[y[1] - top] * y[2][:, None]
        share: Float32Array = rows[:, x[0] - left] * (1 - x[2]) + rows[:, x[1] - left] * x[2]
        return share

    def _window(self, x: _Neighbours, y: _Neighbours) -> tuple[NDArray[np.int32], int, int]:
        """The labels that have a say in a box, and the indices of the first column and row."""
        left, top = (max(0, int(axis[0].min()) - self.softness) for axis in (x, y))
        right, bottom = (int(axis[1].max()) + 1 + self.softness for axis in (x, y))
        return self.labels[top:bottom, left:right], left, top

    def _neighbours(self, box: Box) -> tuple[_Neighbours, _Neighbours]:
        """Labels before and after the px of a box, along x and along y."""
        height, width = self.labels.shape
        return (
            _neighbours(box[0], box[2], self.factor, width),
            _neighbours(box[1], box[3], self.factor, height),
        )


def _neighbours(start: int, stop: int, factor: int, count: int) -> _Neighbours:
    """Labels before and after each canvas px, and the share of the second; the border repeats itself."""
    place = (np.arange(start, stop) + 0.5) / factor - 0.5
    before = np.floor(place).astype(np.intp)
    share = (place - before).astype(np.float32)
    return np.clip(before, 0, count - 1), np.clip(before + 1, 0, count - 1), share


def find_seams(
    survey: Survey, exposure: Exposure, graphcut: bool, progress: Callable[[float], None] | None = None
) -> SeamMap:
    """Owner of every px.

    Parameters
    ----------
    survey : Survey
    exposure : Exposure
        Differences in brightness must not steer the seams.
    graphcut : bool
        Whether seams avoid what differs; otherwise they run where borders are equally far.
    progress : callable, optional
        Told the share of the work done.
    """
    width, height = survey.canvas.size
    labels = np.full((height, width), NOBODY, dtype=np.int32)
    weights = np.zeros((height, width), dtype=np.float32)
    channels = next((t.pixels.shape[2] for t in survey.tiles if t is not None), 1)
    composite = np.zeros((height, width, channels), dtype=np.float32) if graphcut else None
    for index, tile in enumerate(survey.tiles):
        if tile is not None:
            x0, y0, x1, y1 = tile.box
            cut = np.s_[y0:y1, x0:x1]
            if composite is None:
                won = tile.inside & (tile.weight > weights[cut])
            else:
                pixels = exposure.correct(index, survey.warps[index], tile.box, tile.pixels)
                pixels *= np.float32(1.0 / full_scale(tile.pixels.dtype))
                won = _cut(tile, pixels, composite[cut], labels[cut] != NOBODY, weights[cut])
                composite[cut][won] = pixels[won]
            labels[cut][won] = index
            weights[cut][won] = tile.weight[won]
        if progress is not None:
            progress((index + 1) / len(survey.tiles))
    return SeamMap(labels, survey.factor)


def _cut(
    tile: SurveyTile, pixels: Float32Array, below: Float32Array, covered: NDArray[np.bool_], weights: Float32Array
) -> NDArray[np.bool_]:
    """Where a new picture replaces what lies below it."""
    both = tile.inside & covered
    share = tile.weight / np.maximum(tile.weight + weights, np.float32(1e-12))
    alone: NDArray[np.bool_] = tile.inside & ~covered
    free = both & (share > _LEAST_SHARE) & (share < _LARGEST_SHARE)
    surely_new: NDArray[np.bool_] = alone | (both & (share >= _LARGEST_SHARE))
    surely_old = covered & ~(surely_new | free)
    if not free.any():
        return surely_new
    if not surely_old.any():
        return np.asarray(surely_new | free)
    if not surely_new.any():
        return surely_new
    # A cut runs where it is free to; what is farther off only takes time.
    y0, y1, x0, x1 = (limit for axis in (1, 0) for limit in _reach(free.any(axis=axis)))
    part = np.s_[y0:y1, x0:x1]
    masks = [(free | sure)[part].astype(np.uint8) * np.uint8(255) for sure in (surely_old, surely_new)]
    images = [_three_channels(image[part]) for image in (below, pixels)]
    won = surely_new.copy()
    won[part] |= free[part] & _graph_cut(images, masks)
    return won


def _reach(present: NDArray[np.bool_]) -> tuple[int, int]:
    """Start and stop of what is present along an axis, with room for what surely belongs to either side."""
    where = np.flatnonzero(present)
    return max(0, int(where[0]) - _AROUND_FREE), min(len(present), int(where[-1]) + 1 + _AROUND_FREE)


def _graph_cut(images: list[Float32Array], masks: list[NDArray[np.uint8]]) -> NDArray[np.bool_]:
    """Where the second of two images wins; the px that one mask alone has are what the cut must separate."""
    # The stubs know neither the class nor a UMat made of an array.
    detail: Any = cv2
    finder = detail.detail_GraphCutSeamFinder("COST_COLOR_GRAD")
    result = finder.find([detail.UMat(i) for i in images], [(0, 0), (0, 0)], [detail.UMat(m) for m in masks])
    return np.asarray(result[1].get() > 0)


def _three_channels(pixels: Float32Array) -> Float32Array:
    """The finder's cost is made for three channels with values of 0 to 255."""
    channels = [pixels[..., k] for k in range(3)] if pixels.shape[2] >= 3 else [pixels[..., 0]] * 3
    return np.stack(channels, axis=-1) * np.float32(255.0)
