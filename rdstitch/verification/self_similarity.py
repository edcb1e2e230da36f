"""Would two images look as much alike somewhere else? On a repeated pattern they do, and no registration can know.

Both images are drawn on the plane, and correlated at every shift at once (masked normalized cross-correlation,
Padfield 2012). Where the plane is metric a shift by a period of the pattern is as good as the right one.
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import to_plane
from rdstitch.numerics.parabola import parabola_peak
from rdstitch.verification.limits import Limits
from rdstitch.verification.photometric_agreement import ComparedImage, Grey

MAX_SIDE = 256  # pixels of the images that are compared
_COARSE_SIDE = 128  # pixels of those that are compared first, in a quarter of the time
_DECIDED = 0.75  # of the correlation here: where they reach less elsewhere, larger ones do not reach the limit either
_MAX_PX = 4  # times the sides of an image that its outline on the plane may have
COARSEST = 8.0  # pixels, standard deviation of the blur that brightness is measured by
_MIN_SHIFT = 14  # pixels: shifts that are none
SLACK = 3  # pixels by which the registration may be off
_NOISE = 0.02  # share of the power of an image that is noise and resampling, at least
_MIN_NORM = 1e-4  # of the largest: where fewer pixels overlap, rounding decides


@dataclass(frozen=True)
class Ambiguity:
    """How well two images fit where they were put, and elsewhere."""

    # here, elsewhere: correlation where the registration says, and the best at any other shift that keeps half of the
    # overlap or more; 0 where nothing can be compared
    here: float
    elsewhere: float
    shift: float  # length of that shift, as a share of the longer side of an image

    @property
    def ambiguous(self) -> bool:
        """Whether the images fit elsewhere as well as here."""
        left, left_elsewhere = max(1.0 - self.here**2, _NOISE), 1.0 - self.elsewhere**2
        as_well = self.elsewhere > max(Limits.min_correlation, Limits.ambiguous_correlation_ratio * self.here)
        return as_well and left_elsewhere < Limits.ambiguous_residual_ratio * left


@dataclass(frozen=True, eq=False)
class Drawing:
    """An image drawn on the plane, without its brightness."""

    pixels: Grey  # (h, w), float32: NaN where the image is not
    origin: FloatArray  # (2,): where their first pixel lies, pixels of the plane


def drawing_scale(camera: Camera, homography: FloatArray, longest_side: int = MAX_SIDE) -> float:
    """Pixels per unit of the plane at which the middle of an image keeps its size, made small."""
    width, height = camera.image_size
    around = np.array([[width / 2 + dx, height / 2 + dy] for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1))])
    left, right, top, bottom = to_plane(camera, homography, around)
    (ax, ay), (bx, by) = right - left, bottom - top
    area = abs(ax * by - ay * bx) / 4.0
    return float(min(1.0, longest_side / max(height, width)) / np.sqrt(area))


def draw(image: ComparedImage, scale: float, longest_side: int = MAX_SIDE, coarsest: float = COARSEST) -> Drawing:
    """Draw an image on the plane with so many pixels a unit; ``longest_side`` is that of :func:`drawing_scale`.

    What is coarser than a blur by ``coarsest`` pixels counts as brightness.
    """
    outline = to_plane(image.camera, image.homography, image.camera.outline(16)) * scale
    if not np.isfinite(outline).any():  # all of it behind the horizon
        return Drawing(np.full((1, 1), np.nan, dtype=np.float32), np.zeros(2))
    middle = np.nanmedian(outline, axis=0)
    reach = _MAX_PX / 2.0 * longest_side
    low, high = (
        np.clip(edge, middle - reach, middle + reach) for edge in (np.nanmin(outline, 0), np.nanmax(outline, 0))
    )
    origin = np.floor(low)
    width, height = np.maximum(np.ceil(high - origin).astype(int), 1).tolist()
    # The image is smaller on the plane than it is: without a blur it would alias.
    factor = max(1.0, max(image.grey.shape) / longest_side)
    if factor > 1.05:
        blurred = np.asarray(cv2.GaussianBlur(image.grey, (0, 0), 0.5 * factor), dtype=np.float32)
        image = replace(image, grey=blurred)
    drawn = image.sampled(lambda px: (px + origin) / scale, (0, 0, width, height))
    return Drawing(_without_brightness(drawn, coarsest), origin)


def placement_ambiguity(first: Drawing, second: Drawing, longest_side: int = MAX_SIDE) -> Ambiguity:
    """Compare two images, drawn at the same scale, at all shifts on the plane."""
    reduction = longest_side / MAX_SIDE
    overlaps = Overlaps.of(first.pixels, second.pixels)
    # Position of the first image within the second: rows and columns count from -(size - 1) of the first.
    rows, columns = (np.arange(n) - (m - 1) for n, m in zip(overlaps.area.shape, first.pixels.shape, strict=True))
    right, down = np.rint(first.origin - second.origin)
    distance = np.hypot((rows - down).astype(np.float32)[:, None], (columns - right).astype(np.float32))
    near = distance <= reduction * SLACK
    most = float(overlaps.area[near].max(initial=0.0))
    if not most > 0:
        return Ambiguity(0.0, 0.0, 0.0)
    score = overlaps.correlation()
    # A peak of its own, not the flank of the one here.
    peak = score >= cv2.dilate(score, np.ones((2 * math.ceil(reduction * SLACK) + 1,) * 2, dtype=np.uint8))
    enough = overlaps.area >= Limits.min_kept_overlap * most
    other = np.where(peak & (distance > reduction * _MIN_SHIFT) & enough, score, np.float32(0.0))
    best = int(other.argmax())
    elsewhere = _between_pixels(score, *np.unravel_index(best, score.shape)) if other.flat[best] else 0.0
    return Ambiguity(float(score[near].max()), elsewhere, float(distance.flat[best]) / longest_side)


def _between_pixels(score: Grey, row: np.intp, column: np.intp) -> float:
    """Height of a peak between pixels, along both axes: a period is no whole number of pixels."""
    here = top = float(score[row, column])
    for line, at in ((score[:, column], row), (score[row], column)):
        if 0 < at < len(line) - 1:
            top += float(parabola_peak(*line[at - 1 : at + 2].astype(np.float64))[1]) - here
    return min(top, 1.0)


def find_ambiguity(first: ComparedImage, second: ComparedImage) -> Ambiguity:
    """Draw two images on the plane at the scale of the second one, and compare them at all shifts."""
    for side in (_COARSE_SIDE, MAX_SIDE):
        scale, coarsest = drawing_scale(second.camera, second.homography, side), COARSEST * side / MAX_SIDE
        drawn = [draw(image, scale, side, coarsest) for image in (first, second)]
        ambiguity = placement_ambiguity(drawn[0], drawn[1], side)
        if ambiguity.elsewhere < _DECIDED * ambiguity.here:
            break
    return ambiguity


def _without_brightness(image: Grey, coarsest: float) -> Grey:
    """What is finer than a blur, where the image is."""
    seen = np.isfinite(image)
    weight = cv2.GaussianBlur(seen.astype(np.float32), (0, 0), coarsest)
    coarse = cv2.GaussianBlur(np.where(seen, image, np.float32(0)), (0, 0), coarsest) / np.maximum(weight, 1e-6)
    return np.where(seen, image - coarse, np.float32(np.nan)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Overlaps:
    """Sums over the overlap of two images, the first at every position in the second, shape (h, w) each."""

    products: Grey  # products, squares1, squares2: of the values of both images, and of either
    squares1: Grey
    squares2: Grey
    area: Grey  # number of pixels

    @classmethod
    def of(cls, first: Grey, second: Grey) -> "Overlaps":
        """The sums of two images, by the convolution theorem."""
        height, width = (a + b - 1 for a, b in zip(first.shape, second.shape, strict=True))
        a, aa, am = _spectra(first[::-1, ::-1], height, width)
        b, bb, bm = _spectra(second, height, width)
        inverse = cv2.DFT_INVERSE | cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT
        sums = [
            np.asarray(cv2.dft(cv2.mulSpectrums(one, two, 0), flags=inverse), dtype=np.float32)[:height, :width]
            for one, two in ((a, b), (aa, bm), (am, bb), (am, bm))
        ]
        products, squares1, squares2, area = sums
        return cls(products, squares1, squares2, np.rint(area))

    def correlation(self, box: tuple[slice, slice] = (slice(None), slice(None))) -> Grey:
        """Normalized correlation at the positions in a box; at all of them if not given."""
        norm = np.sqrt(np.maximum(self.squares1[box], 0.0) * np.maximum(self.squares2[box], 0.0))
        floor = _MIN_NORM * max(float(norm.max()), 1e-12)
        return np.where(norm > floor, self.products[box] / np.maximum(norm, floor), np.float32(0.0))


def _spectra(image: Grey, height: int, width: int) -> list[Grey]:
    """Spectra of the values, of their squares, and of where there are any, in OpenCV's packed format."""
    seen = np.isfinite(image)
    values = np.where(seen, image, np.float32(0.0))
    shape = (cv2.getOptimalDFTSize(height), cv2.getOptimalDFTSize(width))
    spectra: list[Grey] = []
    for part in (values, values * values, seen):
        padded = np.zeros(shape, dtype=np.float32)
        padded[: part.shape[0], : part.shape[1]] = part
        spectra.append(np.asarray(cv2.dft(padded), dtype=np.float32))
    return spectra
