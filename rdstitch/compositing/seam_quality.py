"""Whether the seams hold: what a person sees where one image of the output ends and the next begins.

Along every border of two images, windows of both are compared. A place does not fit where the two differ at the border
itself, and either fit clearly better with one of them moved, or edges of one are not in the other. What differs beside
the border does not count: a seam that goes around a moving object holds; nor does what is finer than a seam's
surroundings: gravel and leaves hide it. By this layouts are compared. A person sees a seam broken where, besides, a
line of one image does not go on in the other: branches, shadows and pebbles hide it.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import cv2
import numpy as np

from rdstitch.arrays import AnyArray, BoolArray, Float32Array, FloatArray, Int32Array, IntArray
from rdstitch.compositing.boxes import Box
from rdstitch.compositing.seam_lines import SeamLines
from rdstitch.system.late_imports import csgraph

DIAGONAL = 1000.0  # pixels of an image's diagonal at which seams are looked at: about what a screen shows of it
_HALF = 12  # half a window, pixels
_STEP = 8  # pixels from one window to the next
_REACHES = 8, 16  # pixels that a window is searched for within, the shorter where the image ends
_BORDER = 2  # pixels on either side of a seam at which a difference shows
# Of the range of grey levels: standard deviation in a window that has texture, and of a difference that is seen.
CONTRAST = 6.0 / 255.0
_ALIKE = 0.75  # correlation of a moved window
_GAIN = 0.2  # by which that is more than the correlation of the window where it is
_MOVED = 3.0  # pixels that such a window is moved by
UNLIKE = 0.4  # correlation below which edges on both sides are not the same
# Fraction of the overlaps that images reach where they do not belong, in nine of ten cases (0.1 in the median).
_CHANCE = 0.2
_MIN_ALIKE = 0.5  # fraction that what fills less than half of the images cannot reach
# Coherence of edges (0: all directions, 1: one) from which on they are an object's, and no leaves or gravel.
_DIRECTED = 0.4
_MIN_LINE = 2 * _HALF  # pixels of a line that a person follows: longer than the window that it crosses
_NEXT = 2.2 * _STEP  # pixels up to which places of a border follow each other
_MAX_BROKEN = 0.03  # fraction of the places that may be broken before a person sees it
_MIN_BROKEN = 3  # places: fewer are not seen
_MAX_LENGTH = 0.045  # of a break that a person does not see, diagonals of an image
_SURELY_ALIKE = 0.9  # correlation of windows that need not be moved


@dataclass(frozen=True, eq=False)
class SeamTile:
    """One image where seams are looked at."""

    box: Box  # on the canvas of the tiles
    grey: AnyArray  # (h, w): uint8 of images of 8 bits, else float32
    inside: BoolArray  # (h, w)


@dataclass(frozen=True)
class SeamBreak:
    """A stretch of a seam whose two sides do not fit."""

    images: tuple[int, int]
    position: tuple[float, float]  # its middle, pixels of the output
    length: float  # along the seam, pixels of the output
    size: float  # by how much its content is shifted, pixels of the output; NaN where it does not match at all


@dataclass(frozen=True, eq=False)
class SeamQuality:
    """The seams of an output, place by place."""

    # (N, 2): places along the seams at which both images have texture, pixels of the output
    places: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    misfit: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))  # (N,): both sides do not fit
    broken: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))  # (N,): and a line ends
    misfits: tuple[SeamBreak, ...] = ()  # stretches that do not fit, the longest first
    breaks: tuple[SeamBreak, ...] = ()  # those where a line ends
    spacing: float = math.inf  # of the places, pixels of the output
    alike: float = math.nan  # share of the overlaps that looks alike, [0, 1]; NaN where there is nothing to compare
    fills: float = math.nan  # share of the images, over all pairs, that is not seen to look different in the other
    least_alike: tuple[int, int] | None = None  # the images whose overlap does so the least

    @property
    def mostly_unlike(self) -> bool:
        """Whether most of what the images share does not look alike: it may be something else that holds them."""
        return self.alike < _MIN_ALIKE

    @property
    def no_better_than_chance(self) -> bool:
        """Whether the images are no more alike where they overlap than anywhere else."""
        return self.alike < _CHANCE

    @property
    def broken_fraction(self) -> float:
        """Share of the places that is broken, [0, 1]."""
        return float(self.broken.mean()) if len(self.broken) else 0.0

    @property
    def seams_fit(self) -> bool:
        """Whether both sides of the seams fit, but for a few short stretches."""
        return not self._many(self.misfit, self.misfits)

    @property
    def broken_at_reference_size(self) -> bool:
        """Whether a person sees a long break, or many, where images have a diagonal of :data:`DIAGONAL`."""
        return self._many(self.broken, self.breaks)

    @property
    def broken_in_output(self) -> bool:
        """Whether a person sees that in the output too: a smaller one shows what is as long as a window."""
        longest = max((one.length for one in self.breaks), default=0.0)
        return self.broken_at_reference_size and (self.spacing >= _STEP or longest > 2 * _HALF)

    def _many(self, counted: BoolArray, stretches: tuple[SeamBreak, ...]) -> bool:
        longest = stretches[0].length if stretches else 0.0
        many = counted.sum() >= _MIN_BROKEN and counted.mean() > _MAX_BROKEN
        return bool(many) or longest > _MAX_LENGTH * DIAGONAL / _STEP * self.spacing

    def cropped(self, box: Box) -> "SeamQuality":
        """The same of a part of the output."""
        corner, last = np.array(box[:2]), np.array(box[2:]) - 0.5
        within = ((self.places >= corner - 0.5) & (self.places < last)).all(axis=1)
        misfits, breaks = (
            tuple(
                replace(one, position=(one.position[0] - box[0], one.position[1] - box[1]))
                for one in stretches
                if box[0] - 0.5 <= one.position[0] < box[2] - 0.5 and box[1] - 0.5 <= one.position[1] < box[3] - 0.5
            )
            for stretches in (self.misfits, self.breaks)
        )
        return replace(
            self,
            places=self.places[within] - corner,
            misfit=self.misfit[within],
            broken=self.broken[within],
            misfits=misfits,
            breaks=breaks,
        )


def measure_seams(
    tiles: Sequence[SeamTile | None], labels: Int32Array, label_size: float, unit: float, full: float = 255.0
) -> SeamQuality:
    """Compare both sides of all seams.

    ``labels`` (h, w) are the owners of the pixels of a reduced canvas, -1 where there is none, each ``label_size``
    pixels of the tiles long; ``unit`` is pixels of the output for one of the tiles, ``full`` the grey level of white.
    """
    pairs, at = _border_places(labels, label_size)
    searchable: dict[int, dict[int, BoolArray]] = {}  # by image
    lines = SeamLines(labels, label_size, _HALF)
    measured: list[tuple[IntArray, FloatArray, _Verdict]] = []
    ordered, start = np.unique(pairs, axis=0, return_index=True)
    for pair, along in zip(ordered, np.split(at, start[1:]), strict=False):
        first, second = (tiles[k] for k in pair)
        if first is None or second is None:
            continue
        for k, tile in zip(pair.tolist(), (first, second), strict=True):
            if k not in searchable:
                searchable[k] = _searchable(tile.inside)
                lines.add(k, tile.box, tile.grey, full, _MIN_LINE)
        areas1, areas2 = (searchable[k] for k in pair.tolist())
        here, reaches = _comparable_places((first, areas1), (second, areas2), along)
        near_border = _on_border(labels, label_size, pair)
        verdicts = _verdicts(first, second, np.rint(here).astype(np.intp), reaches, near_border, CONTRAST * full)
        measured += [
            (pair, place, verdict) for place, verdict in zip(here, verdicts, strict=True) if verdict is not None
        ]
    if not measured:
        return SeamQuality(spacing=_STEP * unit)
    images, places = np.array([pair for pair, _, _ in measured]), np.array([place for _, place, _ in measured])
    misfit, shift = (np.array(values) for values in zip(*(verdict for _, _, verdict in measured), strict=True))
    runs, broken = _runs(images, places, misfit), np.zeros_like(misfit)
    for run in runs:
        ends = np.array([lines.end(images[k], places[k]) for k in run])
        near = np.hypot(*(places[run, None] - places[run]).T) <= _NEXT
        broken[run] = (near & ends).any(axis=1)
    misfits, breaks = (
        tuple(sorted((_stretch(images, places, shift, run, unit) for run in each), key=lambda one: -one.length))
        for each in (runs, _runs(images, places, broken))
    )
    return SeamQuality((places + 0.5) * unit - 0.5, misfit, broken, misfits, breaks, _STEP * unit)


def _border_places(labels: Int32Array, label_size: float) -> tuple[IntArray, FloatArray]:
    """Pairs of owners (N, 2), ascending, and places of their borders (N, 2) on the canvas of the tiles."""
    borders = []
    for first, second, right, down in ((labels[:, :-1], labels[:, 1:], 0.5, 0.0), (labels[:-1], labels[1:], 0.0, 0.5)):
        y, x = np.nonzero((first != second) & (first >= 0) & (second >= 0))
        owners = np.sort(np.column_stack([first[y, x], second[y, x]]), axis=1)
        at = (np.column_stack([x + right, y + down]) + 0.5) * label_size - 0.5
        borders.append(np.column_stack([owners, at]))
    every = np.concatenate(borders)
    keys = np.column_stack([every[:, :2], np.floor(every[:, 2:] / _STEP)]).astype(np.int64)
    order = np.lexsort((every[:, 3], every[:, 2], *keys.T[::-1]))
    every, keys = every[order], keys[order]
    starts = np.flatnonzero(np.concatenate([[True], (keys[1:] != keys[:-1]).any(axis=1)])) if len(keys) else order
    middle = (starts + np.append(starts[1:], len(keys))) // 2 if len(keys) else order
    return every[middle, :2].astype(np.intp), every[middle, 2:]


def _searchable(inside: BoolArray) -> dict[int, BoolArray]:
    """Mark where windows can be searched for in an image (h, w), by reach."""
    kernels = {reach: np.ones((2 * (_HALF + reach) + 1,) * 2, np.uint8) for reach in _REACHES}
    opaque, outside = inside.astype(np.uint8), cv2.BORDER_CONSTANT
    return {reach: cv2.erode(opaque, k, borderType=outside, borderValue=(0,)) > 0 for reach, k in kernels.items()}


class _Verdict(NamedTuple):
    """Whether both sides of a seam do not fit at a place, and by how much they are shifted; NaN if they are unlike."""

    misfit: bool
    shift: float


def _comparable_places(
    first: tuple[SeamTile, dict[int, BoolArray]], second: tuple[SeamTile, dict[int, BoolArray]], at: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Select places (N, 2) of a border where windows fit into both tiles; gives also how far they can be searched."""
    whole, reaches = np.rint(at).astype(np.intp), np.zeros(len(at), dtype=np.intp)
    (tile1, areas1), (tile2, areas2) = first, second
    for reach in _REACHES:
        reaches[_looked_up(areas1[reach], tile1.box, whole) & _looked_up(areas2[reach], tile2.box, whole)] = reach
    return at[reaches > 0], reaches[reaches > 0]


def _verdicts(
    first: SeamTile,
    second: SeamTile,
    at: IntArray,
    reaches: IntArray,
    near_border: Callable[[IntArray], BoolArray],
    contrast: float,
) -> Iterator[_Verdict | None]:
    """Judge each place (N, 2), pixels; None where neither image has texture."""
    if not len(at):
        return
    windows1, windows2, near = _windows(first, at), _windows(second, at), near_border(at)
    flat1, flat2 = (windows.reshape(len(at), -1) for windows in (windows1, windows2))
    spread = np.stack([flat1.std(axis=1), flat2.std(axis=1)])
    differ, alike = _difference(windows1, windows2, near), correlation(flat1, flat2)
    for k, (place, reach) in enumerate(zip(at, reaches.tolist(), strict=True)):
        if spread[:, k].max() < contrast:
            yield None
        elif spread[:, k].min() < contrast:  # one side is empty of what the other has
            misfit = bool(differ[k] > 2.0 * contrast)
            yield _Verdict(misfit, math.nan if misfit else 0.0)
        elif differ[k] <= contrast or alike[k] >= _SURELY_ALIKE:
            yield _Verdict(False, 0.0)
        else:
            best, shift = _best_shift(first, second, place, reach)
            moved = shift > _MOVED and best > _ALIKE and best - alike[k] > _GAIN
            edges, directions = zip(_edges(windows1[k]), _edges(windows2[k]), strict=True)
            unlike = alike[k] < UNLIKE and max(edges) > contrast and max(directions) > _DIRECTED
            misfit = bool(moved or unlike) and _differ_coarsely(windows1[k], windows2[k], near[k], contrast)
            yield _Verdict(misfit, (shift if moved else math.nan) if misfit else 0.0)


def _looked_up(mask: BoolArray, box: Box, whole: IntArray) -> BoolArray:
    """The mask on a box at places (N, 2) of the canvas; False beyond."""
    x, y = whole[:, 0] - box[0], whole[:, 1] - box[1]
    height, width = mask.shape
    within = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    return np.asarray(within & mask[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)])


def _windows(tile: SeamTile, whole: IntArray) -> Float32Array:
    """Windows (N, side, side) of a tile around places (N, 2) of the canvas."""
    side = 2 * _HALF + 1
    x, y = (whole - tile.box[:2] - _HALF).T
    return np.asarray(np.lib.stride_tricks.sliding_window_view(tile.grey, (side, side))[y, x], dtype=np.float32)


def _on_border(labels: Int32Array, label_size: float, pair: IntArray) -> Callable[[IntArray], BoolArray]:
    """Which pixels (N, side, side) of windows around places (N, 2) are near both owners."""

    def border(whole: IntArray) -> BoolArray:
        offsets = np.arange(-_HALF - _BORDER, _HALF + _BORDER + 1)
        x, y = ((whole[:, k, None] + offsets + 0.5) / label_size for k in (0, 1))
        columns = np.clip(x.astype(np.intp), 0, labels.shape[1] - 1)
        rows = np.clip(y.astype(np.intp), 0, labels.shape[0] - 1)
        owners = labels[rows[:, :, None], columns[:, None, :]]
        side, near = 2 * _HALF + 1, np.ones((len(whole), 2 * _HALF + 1, 2 * _HALF + 1), dtype=np.bool_)
        for owner in pair:
            owned = owners == owner
            across = np.logical_or.reduce([owned[:, :, k : k + side] for k in range(2 * _BORDER + 1)])
            near &= np.logical_or.reduce([across[:, k : k + side] for k in range(2 * _BORDER + 1)])
        return near

    return border


def _difference(windows1: Float32Array, windows2: Float32Array, mask: BoolArray) -> FloatArray:
    """Standard deviation of what two windows differ by where the mask is, but for brightness and some contrast."""
    u, v, counted = (each.reshape(len(mask), -1) for each in (windows1, windows2, mask.astype(np.float32)))
    count = np.maximum(counted.sum(axis=1), 1)
    u, v = ((w - np.einsum("ij,ij->i", w, counted)[:, None] / count[:, None]) * counted for w in (u, v))
    uu, vv, uv = (np.einsum("ij,ij->i", a, b) / count for a, b in ((u, u), (v, v), (u, v)))
    larger, smaller = np.maximum(uu, vv), np.minimum(uu, vv)
    gain = np.clip(uv / np.maximum(larger, 1e-9), 0.5, 1.0)
    return np.asarray(np.sqrt(np.maximum(smaller - 2.0 * gain * uv + gain**2 * larger, 0.0)), dtype=np.float64)


def _differ_coarsely(window1: Float32Array, window2: Float32Array, mask: BoolArray, contrast: float) -> bool:
    """Whether two windows differ where the mask is when what is finer than a seam's surroundings is smoothed away."""
    first, second = (
        cv2.GaussianBlur(window, (0, 0), _BORDER)[None].astype(np.float32) for window in (window1, window2)
    )
    return bool(_difference(first, second, mask[None])[0] > contrast)


def correlation(windows1: FloatArray | Float32Array, windows2: FloatArray | Float32Array) -> FloatArray:
    """Normalized correlation of windows (N, pixels)."""
    u, v = (w - w.mean(axis=1, keepdims=True) for w in (windows1, windows2))
    uu, vv, uv = (np.einsum("ij,ij->i", a, b) for a, b in ((u, u), (v, v), (u, v)))
    return np.asarray(uv / np.maximum(np.sqrt(uu * vv), 1e-9), dtype=np.float64)


def _best_shift(first: SeamTile, second: SeamTile, at: IntArray, reach: int) -> tuple[float, float]:
    """Highest correlation of windows at any shift, and its length; NaN where the way back is another."""
    peaks = []
    for one, other in ((first, second), (second, first)):
        x, y = at - one.box[:2]
        u, v = at - other.box[:2]
        wide = other.grey[v - _HALF - reach : v + _HALF + reach + 1, u - _HALF - reach : u + _HALF + reach + 1]
        window = one.grey[y - _HALF : y + _HALF + 1, x - _HALF : x + _HALF + 1]
        scores = cv2.matchTemplate(np.ascontiguousarray(wide), np.ascontiguousarray(window), cv2.TM_CCOEFF_NORMED)
        _, best, _, place = cv2.minMaxLoc(scores)
        peaks.append((best, np.array(place) - reach))
    (best, forward), (_, backward) = peaks
    return best, float(np.hypot(*forward)) if np.hypot(*(forward + backward)) <= 2 else math.nan


def _edges(window: Float32Array) -> tuple[float, float]:
    """The strong edges of a window, grey levels a pixel, and how much they have one direction, [0, 1]."""
    x, y = (cv2.Sobel(window, cv2.CV_32F, dx, 1 - dx, scale=1 / 8) for dx in (1, 0))
    xx, yy, xy = (float((u * v).sum()) for u, v in ((x, x), (y, y), (x, y)))
    return float(np.quantile(np.hypot(x, y), 0.9)), math.hypot(xx - yy, 2.0 * xy) / max(xx + yy, 1e-9)


def _runs(images: IntArray, places: FloatArray, chosen: BoolArray) -> list[IntArray]:
    """Indices of the places of one border that were chosen and follow each other."""
    indices, runs = np.flatnonzero(chosen), list[IntArray]()
    for border in np.unique(images[indices], axis=0):
        of_border = indices[(images[indices] == border).all(axis=1)]
        near = np.hypot(*(places[of_border, None] - places[of_border]).T) <= _NEXT
        group = csgraph.connected_components(near, directed=False)[1]
        runs += np.split(of_border[np.argsort(group, kind="stable")], np.cumsum(np.bincount(group))[:-1])
    return runs


def _stretch(images: IntArray, places: FloatArray, shift: FloatArray, run: IntArray, unit: float) -> SeamBreak:
    """Places of one border that follow each other, as one."""
    at, known = places[run], shift[run][np.isfinite(shift[run])]
    middle = at[np.argmin(np.hypot(*(at - at.mean(axis=0)).T))]
    i, j = images[run[0]].tolist()
    x, y = ((middle + 0.5) * unit - 0.5).tolist()
    length = float(np.hypot(*np.ptp(at, axis=0))) + _STEP
    return SeamBreak((i, j), (x, y), length * unit, float(np.median(known)) * unit if len(known) else math.nan)
