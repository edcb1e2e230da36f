"""Would two pictures look as much alike somewhere else? On a repeated pattern they do, and no registration can know.

Both pictures are drawn on the plane, and correlated at every shift at once (masked normalized cross-correlation,
Padfield 2012). Where the plane is metric a shift by a period of the pattern is as good as the right one.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from rdstitch.arrays import FloatArray
from rdstitch.radial_homography import to_plane
from rdstitch.verification.photometric_agreement import Grey, PlacedPicture

_LONGEST_SIDE = 256  # pixels of the pictures that are compared
_MOST_PX = 4  # times the sides of a picture that its outline on the plane may have
_COARSEST = 8.0  # pixels, standard deviation of the blur that brightness is measured by
_NEAR = 14  # pixels: shifts that are none
_SLACK = 3  # pixels by which the registration may be off
_LEAST_NORM = 1e-4  # of the largest: where fewer pixels overlap, rounding decides
_LEAST_SHARE = 0.5  # of the overlap that a shift must keep
_ALIKE = 0.5  # correlation from which on two pictures look alike
_AS_GOOD = 0.9  # of the correlation here; a repeated pattern reaches 0.97, other pictures seldom 0.5


@dataclass(frozen=True)
class Ambiguity:
    """How well two pictures fit where they were put, and elsewhere.

    Attributes
    ----------
    here, elsewhere : float
        Correlation where the registration says, and the best at any other shift that keeps half of the overlap or
        more; 0 where nothing can be compared.
    shift : float
        Length of that shift, as a share of the longer side of a picture.
    """

    here: float
    elsewhere: float
    shift: float

    @property
    def ambiguous(self) -> bool:
        """Whether the pictures fit elsewhere as well as here."""
        return self.elsewhere > max(_ALIKE, _AS_GOOD * self.here)


@dataclass(frozen=True)
class Drawing:
    """A picture drawn on the plane, without its brightness.

    Attributes
    ----------
    pixels : ndarray of shape (h, w), float32
        NaN where the picture is not.
    origin : ndarray of shape (2,)
        Where their first pixels lies, pixels of the plane.
    """

    pixels: Grey
    origin: FloatArray


def drawing_scale(picture: PlacedPicture) -> float:
    """Px per unit of the plane at which the middle of a picture keeps its size, made small."""
    height, width = picture.grey.shape
    around = np.array([[width / 2 + dx, height / 2 + dy] for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1))])
    left, right, top, bottom = to_plane(picture.camera, picture.homography, around)
    (ax, ay), (bx, by) = right - left, bottom - top
    area = abs(ax * by - ay * bx) / 4.0
    return float(min(1.0, _LONGEST_SIDE / max(height, width)) / np.sqrt(area))


def draw(picture: PlacedPicture, scale: float) -> Drawing:
    """Draw a picture on the plane with so many pixels a unit."""
    outline = to_plane(picture.camera, picture.homography, picture.camera.outline(16)) * scale
    if not np.isfinite(outline).any():  # all of it behind the horizon
        return Drawing(np.full((1, 1), np.nan, dtype=np.float32), np.zeros(2))
    middle = np.nanmedian(outline, axis=0)
    reach = _MOST_PX / 2.0 * _LONGEST_SIDE
    low, high = (
        np.clip(edge, middle - reach, middle + reach) for edge in (np.nanmin(outline, 0), np.nanmax(outline, 0))
    )
    origin = np.floor(low)
    width, height = np.maximum(np.ceil(high - origin).astype(int), 1).tolist()
    # The picture is smaller on the plane than it is: without a blur it would alias.
    factor = max(1.0, max(picture.grey.shape) / _LONGEST_SIDE)
    if factor > 1.05:
        blurred = np.asarray(cv2.GaussianBlur(picture.grey, (0, 0), 0.5 * factor), dtype=np.float32)
        picture = replace(picture, grey=blurred)
    drawn = picture.sampled(lambda px: (px + origin) / scale, (0, 0, width, height))
    return Drawing(_without_brightness(drawn), origin)


def placement_ambiguity(first: Drawing, second: Drawing) -> Ambiguity:
    """Compare two pictures, drawn at the same scale, at all shifts on the plane."""
    score, area = _correlation(first.pixels, second.pixels)
    # Position of the first picture within the second: rows and columns count from -(size - 1) of the first.
    rows, columns = (np.arange(n) - (m - 1) for n, m in zip(score.shape, first.pixels.shape, strict=True))
    offset = np.rint(first.origin - second.origin).astype(int)
    distance = np.hypot(rows[:, None] - offset[1], columns[None, :] - offset[0])
    near = distance <= _SLACK
    if not near.any() or not area[near].max() > 0:
        return Ambiguity(0.0, 0.0, 0.0)
    # A peak of its own, not the flank of the one here.
    peak = score >= cv2.dilate(score, np.ones((2 * _SLACK + 1, 2 * _SLACK + 1), dtype=np.uint8))
    other = np.where(peak & (distance > _NEAR) & (area >= _LEAST_SHARE * area[near].max()), score, 0.0)
    best = int(other.argmax())
    elsewhere = float(other.flat[best])
    return Ambiguity(max(0.0, float(score[near].max())), elsewhere, float(distance.flat[best]) / _LONGEST_SIDE)


def _without_brightness(picture: Grey) -> Grey:
    """What is finer than a blur, where the picture is."""
    seen = np.isfinite(picture)
    weight = cv2.GaussianBlur(seen.astype(np.float32), (0, 0), _COARSEST)
    coarse = cv2.GaussianBlur(np.where(seen, picture, np.float32(0)), (0, 0), _COARSEST) / np.maximum(weight, 1e-6)
    return np.where(seen, picture - coarse, np.float32(np.nan)).astype(np.float32)


def _correlation(first: Grey, second: Grey) -> tuple[Grey, Grey]:
    """Normalized correlation at every position of the first picture in the second, and the px that overlap there."""
    shape = [a + b - 1 for a, b in zip(first.shape, second.shape, strict=True)]
    fast = [fft.next_fast_len(n, real=True) for n in shape]
    a, aa, am = _spectra(first[::-1, ::-1], fast)
    b, bb, bm = _spectra(second, fast)
    both, own1, own2, area = (fft.irfft2(p, fast)[: shape[0], : shape[1]] for p in (a * b, aa * bm, am * bb, am * bm))
    norm = np.sqrt(np.maximum(own1, 0.0) * np.maximum(own2, 0.0))
    floor = _LEAST_NORM * max(float(norm.max()), 1e-12)
    return np.where(norm > floor, both / np.maximum(norm, floor), np.float32(0.0)), np.rint(area)


def _spectra(picture: Grey, shape: list[int]) -> list[NDArray[np.complex64]]:
    """Of the values, their squares, and where there are any."""
    seen = np.isfinite(picture)
    values = np.where(seen, picture, np.float32(0.0))
    return [fft.rfft2(part, shape) for part in (values, values * values, seen.astype(np.float32))]
