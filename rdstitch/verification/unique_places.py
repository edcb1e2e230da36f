"""What is unique in a repeated pattern (dirt on tiles, a mark, one object) decides where its images lie.

Each image is compared with itself, shifted by the periods of its own pattern: where it departs from their median,
something is there once. Two images are then compared by these departures alone, at every shift by which the pattern
fits. At the right one, those in the overlap are at the same places in both; at a wrong one, stains lie on clean tiles.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.geometry.radial_homography import from_plane, to_plane
from rdstitch.numerics.parabola import parabola_peak
from rdstitch.verification.limits import Limits
from rdstitch.verification.photometric_agreement import COMPARED_SIDE, ComparedImage, Grey
from rdstitch.verification.self_similarity import Drawing, Overlaps, draw, drawing_scale

_MIN_SHIFT = 10  # pixels: a shorter shift is no period that could be told from the peak itself
_OWN_OVERLAP = 0.15  # fraction of an image that a shift over itself must keep
_OVERLAP = 0.05  # of the most that a shift of two images over each other keeps
_MAX_PERIODS = 16  # shifts that an image is compared with itself at
_MIN_COPIES = 3  # other copies of a place, of which the median is clean though one of them has dirt
_MARGIN = 6  # pixels at the border of an image, where brightness cannot be removed well
_MOST = 25.0  # spreads of the copies: a larger departure counts as this
# Images that are compared at once: seen from above, their drawings and departures fit into 128 MB.
IMAGES_AT_ONCE = 2**27 // (2 * COMPARED_SIDE**2 * np.dtype(np.float32).itemsize)


@dataclass(frozen=True, eq=False)
class UniqueShift:
    """The shift of one image's drawing within another's at which what is unique in both agrees best."""

    # (2,): (x, y) by which the first image must be moved on the plane, pixels of the drawings or units of the plane
    shift: FloatArray
    # what is unique in both and the same, in squared spreads of the pattern times pixels, times ``correlation``
    matched: float
    correlation: float  # of what is unique in either, in the overlap, in [-1, 1]
    matched_elsewhere: float  # the most that is matched so at any other shift

    @property
    def decides(self) -> bool:
        """Whether the images lie here and nowhere else."""
        clear = self.matched >= max(Limits.min_matched_departures, Limits.min_lead * self.matched_elsewhere)
        return clear and self.correlation >= Limits.min_departure_correlation


def unique_shifts(
    placed: Mapping[int, ComparedImage], pairs: Sequence[tuple[int, int]], workers: int = 1
) -> dict[tuple[int, int], UniqueShift]:
    """Compute how far the first image of each pair must be moved for what is unique in both to agree.

    ``placed``: the images, on a plane where a period of the pattern is the same shift everywhere (a metric or an affine
    one); ``workers``: images that are compared at the same time; gives of the pairs of which that decides, in units of
    the plane.
    """
    images = sorted({k for pair in pairs for k in pair})
    if not images:
        return {}
    scale = float(np.median([drawing_scale(placed[k].camera, placed[k].homography, COMPARED_SIDE) for k in images]))

    def prepare(k: int) -> tuple[Drawing, Grey | None]:
        drawing = draw(placed[k], scale, COMPARED_SIDE)
        return drawing, departures(drawing.pixels)

    def compare(pair: tuple[int, int]) -> UniqueShift | None:
        (first, unique1), (second, unique2) = prepared[pair[0]], prepared[pair[1]]
        if unique1 is None or unique2 is None:
            return None
        unique = unique_shift(first, second, unique1, unique2)
        if unique is None or not unique.decides:
            return None
        shift = unique.shift / scale
        return replace(unique, shift=shift) if _moves(placed[pair[0]], placed[pair[1]], shift) else None

    with ThreadPoolExecutor(workers) as pool:
        prepared = dict(zip(images, pool.map(prepare, images), strict=True))
        compared = zip(pairs, pool.map(compare, pairs), strict=True)
        return {pair: unique for pair, unique in compared if unique is not None}


def departures(pixels: Grey) -> Grey | None:
    """How far each pixel (h, w) of a drawing departs from the image's own pattern, in spreads of its copies.

    Gives (h, w): 0 where it does not; NaN where nothing is known. None for an image that shows too few periods.
    """
    shifts, _ = _peaks(Overlaps.of(pixels, pixels), pixels, np.zeros(2), _OWN_OVERLAP)
    periods = shifts[np.hypot(*shifts.T) > _MIN_SHIFT]
    periods = periods[np.argsort(np.hypot(*periods.T), kind="stable")][:_MAX_PERIODS]
    if len(periods) < Limits.min_periods:
        return None
    copies = np.stack([_shifted(pixels, shift) for shift in periods])
    count = np.isfinite(copies).sum(axis=0)
    middle = _median(copies, count)
    spread = 1.4826 * _median(np.abs(copies - middle), count)
    known = (count >= _MIN_COPIES) & np.isfinite(pixels)
    inside = cv2.erode(np.isfinite(pixels).astype(np.uint8), np.ones((2 * _MARGIN + 1,) * 2, np.uint8), borderValue=0)
    if not known.any():
        return None
    departure, usual = (
        np.asarray(cv2.GaussianBlur(np.where(known, values, np.float32(0.0)), (0, 0), 1.0), dtype=np.float32)
        for values in (pixels - middle, spread)
    )
    relative = departure / np.maximum(usual, max(float(np.median(usual[known])), 1e-6))
    size = np.clip(np.abs(relative) - Limits.min_departure, 0.0, _MOST)
    return np.where(known & (inside > 0), np.copysign(size, relative), np.float32(np.nan)).astype(np.float32)


def unique_shift(first: Drawing, second: Drawing, unique1: Grey, unique2: Grey) -> UniqueShift | None:
    """Compare two drawings at one scale by their departures, at every shift by which their pattern fits.

    None where the pattern of both fits nowhere.
    """
    offset = np.rint(first.origin - second.origin)
    shifts, places = _peaks(Overlaps.of(first.pixels, second.pixels), first.pixels, offset, _OVERLAP)
    if not len(shifts):
        return None
    overlaps = Overlaps.of(unique1, unique2)
    matched, scores = np.zeros(len(shifts)), np.zeros(len(shifts))
    for k, (row, column) in enumerate(places.tolist()):
        box = slice(row - 1, row + 2), slice(column - 1, column + 2)
        scores[k] = overlaps.correlation(box).max(initial=0.0)
        matched[k] = scores[k] * overlaps.products[box].max(initial=0.0)
    best = int(matched.argmax())
    elsewhere = np.hypot(*(shifts - shifts[best]).T) > _MIN_SHIFT
    best_elsewhere = float(matched[elsewhere].max(initial=0.0))
    return UniqueShift(shifts[best], float(matched[best]), float(scores[best]), best_elsewhere)


def _peaks(overlaps: Overlaps, first: Grey, offset: FloatArray, least_overlap: float) -> tuple[FloatArray, IntArray]:
    """Peaks of the correlation of two drawings: shifts (N, 2), (x, y) from ``offset`` on, and where they are in it."""
    score = overlaps.correlation()
    kernel = np.ones((2 * _MIN_SHIFT + 1, 2 * _MIN_SHIFT + 1), dtype=np.uint8)
    enough = overlaps.area >= least_overlap * overlaps.area.max()
    peak = (score >= cv2.dilate(score, kernel)) & enough & (score > Limits.min_period_correlation)
    peak[[0, -1]] = peak[:, [0, -1]] = False
    row, column = np.nonzero(peak)
    x, y = (
        parabola_peak(score[row - dy, column - dx], score[row, column], score[row + dy, column + dx])[0]
        for dx, dy in ((1, 0), (0, 1))
    )
    height, width = first.shape
    shift = np.column_stack([column - (width - 1) - offset[0] + x, row - (height - 1) - offset[1] + y])
    return shift, np.column_stack([row, column])


def _shifted(pixels: Grey, shift: FloatArray) -> Grey:
    """An image moved by (x, y); NaN where it is not."""
    matrix = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
    size = pixels.shape[1], pixels.shape[0]
    return np.asarray(
        cv2.warpAffine(
            pixels, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(float("nan"),)
        ),
        dtype=np.float32,
    )


def _median(copies: Grey, count: IntArray) -> Grey:
    """Median over the first axis of known values (N, h, w), of which there are ``count`` (h, w); NaN where none is."""
    ordered = np.sort(copies, axis=0)  # NaN come last
    low, high = (np.take_along_axis(ordered, (np.maximum(count - above, 0) // 2)[None], axis=0)[0] for above in (1, 0))
    return np.asarray(0.5 * (low + np.where(np.isfinite(high), high, low)), dtype=np.float32)


def _moves(first: ComparedImage, second: ComparedImage, shift: FloatArray) -> bool:
    """Whether a shift on the plane moves the second image over the first: dust on the lens is where it was."""
    height, width = first.grey.shape
    middle = np.array([[width / 2.0, height / 2.0]])
    seen = from_plane(second.camera, second.homography, to_plane(first.camera, first.homography, middle) + shift)
    return not bool(np.linalg.norm(seen - middle) <= _MIN_SHIFT)
