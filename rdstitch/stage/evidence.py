"""Evidence for where the second of two tiles lies in the first, in nats (logarithms of odds), and what decides by it.

An overlap whose pixels correlate by 0.6 has about 6 nats, one by 0.9 about 10: it counts for 24 independent pixels at
the most.
"""

import math
from collections.abc import Sequence

import cv2
import numpy as np

from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.numerics.robust_loss import normal_std
from rdstitch.stage.coarse_tile import CORRELATED, CoarseTile, energies
from rdstitch.stage.overlap import Overlap
from rdstitch.stage.phase_correlation import correlate_frames, lay_tapered, peak_threshold, peaks
from rdstitch.system.late_imports import fft

HUNDRED_TO_ONE = math.log(100.0)  # by which a place of a pair stands out against another, or against nothing
WRONG_PEAK = 6.0  # below which a pair is looked for elsewhere: a peak of about 0.6 may be one of a pattern
MIN_AXES_EVIDENCE = 10.0  # below which the nominal axes hold: one overlap that correlates by 0.9
ANYWHERE = math.log(1e-3)  # prior that a tile is anywhere but where its stage was sent, within its errors

_UNLIKE = 0.2  # share of the variance that two images of the same may differ by: interpolation, bleaching, focus
_INDEPENDENT = 24  # independent pieces of evidence that the pixels of an overlap count for
_CONTENT = 0.02  # least share of the variance that is content: the noise is not known better
_WIDE_PEAKS = 6  # highest peaks of two whole tiles that are compared by their normalized cross-correlation
_EDGE = 0.02  # the taper of whole tiles, whose overlap is at their border
_MIN_STEP = 0.35  # displacement of neighbours along one of the axes, at least, share of the side
_MIN_COMMON = 0.02  # share of the side that neighbours have in common, at least


def log_evidence(
    tiles: Sequence[CoarseTile], overlap: Overlap, place: FloatArray, shifts: FloatArray | None = None
) -> float:
    """How much more likely two tiles are with the second at a place (2,) in the first than anywhere else, in nats.

    By their normalized cross-correlation in the blocks of the overlap, each displaced by its shift (K, 2) in addition,
    but for their noise. However many pixels an overlap has, they count as few: neighbours are alike, and what
    interpolation and bleaching change is not independent.
    """
    first, second = (tile.content for tile in tiles)
    noise = np.array([tile.noise for tile in tiles])
    shifts = np.zeros((len(overlap.blocks), 2)) if shifts is None else shifts
    products, pixels, features = np.zeros(3), 0, np.zeros(2)
    for block, moved in zip(overlap.blocks, place + shifts, strict=True):
        low = np.maximum(np.maximum(block[:2], np.ceil(moved).astype(np.intp)), 0)
        high = np.minimum(
            np.minimum(block[2:], np.floor(moved).astype(np.intp) + second.shape[::-1]), first.shape[::-1]
        )
        width, height = (high - low).tolist()
        if min(width, height) < 2:
            continue
        x, y = (low - moved).tolist()
        a = first[low[1] : high[1], low[0] : high[0]]
        middle = x + (width - 1) / 2.0, y + (height - 1) / 2.0
        b = np.asarray(cv2.getRectSubPix(second, (width, height), middle), dtype=np.float32)
        products += [float(np.vdot(a, a)), float(np.vdot(b, b)), float(np.vdot(a, b))]
        features += energies(a)
        pixels += width * height
    if pixels < CORRELATED or not min(products[:2]) > 0.0:
        return 0.0
    content = np.maximum(products[:2] - noise * pixels / CORRELATED, _CONTENT * products[:2])
    correlation = min(1.0, max(0.0, products[2]) / math.sqrt(float(content.prod())))
    chance = math.sqrt(CORRELATED / pixels * float((products[:2] / content).prod()))
    # As many pixels as the energy is spread over, and as are independent: a single bright spot is like any other.
    count = min(_INDEPENDENT, float(products[0] * features[1] / (2.0 * math.pi * max(features[0], 1e-30))))
    unlike = _UNLIKE + 2.0 * chance
    return -0.5 * count * math.log((1.0 - correlation**2 + unlike) / (1.0 + unlike))


def wide_peaks(tiles: Sequence[CoarseTile]) -> tuple[FloatArray, FloatArray]:
    """Places of the second tile anywhere along a side of the first (K, 2), and the evidence for them (K,), nats."""
    sizes, zero = np.array([tile.pixels.shape for tile in tiles]), np.zeros(2, dtype=np.intp)
    shape = tuple(int(fft.next_fast_len(int(side), real=True)) for side in sizes.sum(axis=0))
    frames = np.zeros((2, 1, *shape), dtype=np.float32)
    noise = [
        [lay_tapered(frame, tile.pixels, np.array([0, 0, width, height]), zero, zero, _EDGE)]
        for (frame,), tile, (height, width) in zip(frames, tiles, sizes, strict=True)
    ]
    (surface,), plain = correlate_frames(frames, np.array(noise))
    y, x = (
        np.where(np.arange(n) < side, np.arange(n), np.arange(n) - n) for n, side in zip(shape, sizes[0], strict=True)
    )
    possible = _may_be_neighbours(y, x, sizes)
    if not possible.any():  # in tiles of a few pixels
        return np.zeros((0, 2)), np.zeros(0)
    deviation = normal_std(surface[possible]) + 1e-12
    candidates: dict[tuple[int, int], None] = {}
    # A pattern that repeats itself is as high in many places of the plain correlation, and in chance ones of the other.
    for values, threshold in ((surface, peak_threshold(deviation, surface.size)), (plain, 0.0)):
        masked = np.where(possible, values, 0.0).astype(np.float32)
        candidates |= dict.fromkeys(
            (int(x[column]), int(y[row])) for column, row in peaks(masked, threshold, _WIDE_PEAKS)
        )
    places = np.array(list(candidates), dtype=np.float64).reshape(-1, 2)
    boxes = [Overlap.expected(place, sizes[:, ::-1], 1) for place in places]
    return places, np.array([log_evidence(tiles, box, at) for at, box in zip(places, boxes, strict=True)])


def _may_be_neighbours(y: IntArray, x: IntArray, sizes: IntArray) -> BoolArray:
    """Whether two tiles of sizes (2, 2), height and width, may lie so far apart (len(y), len(x)): side by side."""
    height, width = sizes.min(axis=0)
    down, across = (np.minimum(a, v + b) - np.maximum(0, v) for v, (a, b) in ((y, sizes[:, 0]), (x, sizes[:, 1])))
    # Where they nearly coincide they share the camera and not the specimen.
    aside = (np.abs(y)[:, None] > _MIN_STEP * height) | (np.abs(x) > _MIN_STEP * width)
    broad = (down[:, None] > 0.5 * height) | (across > 0.5 * width)
    enough = (down[:, None] > max(2.0, _MIN_COMMON * height)) & (across > max(2.0, _MIN_COMMON * width))
    return np.asarray(aside & broad & enough)
