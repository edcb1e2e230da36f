"""Would two pictures look as much alike somewhere else? On a repeated pattern they do, and no registration can know.

Both pictures are drawn on the plane, and correlated at every shift at once (masked normalized cross-correlation,
Padfield 2012). Where the plane is metric a shift by a period of the pattern is as good as the right one.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from rdstitch.camera import Camera, FloatArray
from rdstitch.compositing.agreement import Grey, sampled
from rdstitch.radial_homography import from_plane, to_plane

_LONGEST_SIDE = 256  # px of the pictures that are compared
_MOST_PX = 4  # times the sides of a picture that its outline on the plane may have
_COARSEST = 8.0  # px, standard deviation of the blur that brightness is measured by
_NEAR = 14  # px: shifts that are none
_SLACK = 3  # px by which the registration may be off
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


def placement_ambiguity(
    grey1: Grey, grey2: Grey, camera1: Camera, camera2: Camera, homography1: FloatArray, homography2: FloatArray
) -> Ambiguity:
    """Compare two registered pictures at all shifts on the plane.

    Parameters
    ----------
    grey1, grey2 : ndarray of shape (h, w), float32
        As :func:`rdstitch.compositing.agreement.reduced_grey` gives them.
    camera1, camera2 : Camera
        Of the size of the grey pictures.
    homography1, homography2 : ndarray of shape (3, 3)
        From undistorted normalized coordinates of each picture to the plane.
    """
    scale = _px_per_unit(grey2, camera2, homography2)
    drawn1, origin1 = _on_plane(grey1, camera1, homography1, scale)
    drawn2, origin2 = _on_plane(grey2, camera2, homography2, scale)
    score, area = _correlation(drawn1, drawn2)
    # Position of the first picture within the second: rows and columns count from -(size - 1) of the first.
    rows, columns = (np.arange(n) - (m - 1) for n, m in zip(score.shape, drawn1.shape, strict=True))
    offset = np.rint(origin1 - origin2).astype(int)
    distance = np.hypot(rows[:, None] - offset[1], columns[None, :] - offset[0])
    near = distance <= _SLACK
    if not near.any() or not area[near].max() > 0:
        return Ambiguity(0.0, 0.0, 0.0)
    # A peak of its own, not the flank of the one here.
    peak = score >= ndimage.maximum_filter(score, size=2 * _SLACK + 1)
    other = np.where(peak & (distance > _NEAR) & (area >= _LEAST_SHARE * area[near].max()), score, 0.0)
    best = int(other.argmax())
    elsewhere = float(other.flat[best])
    return Ambiguity(max(0.0, float(score[near].max())), elsewhere, float(distance.flat[best]) / _LONGEST_SIDE)


def _px_per_unit(grey: Grey, camera: Camera, homography: FloatArray) -> float:
    """Resolution of the plane at which the middle of a picture keeps its size, made small."""
    height, width = grey.shape
    around = np.array([[width / 2 + dx, height / 2 + dy] for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1))])
    left, right, top, bottom = to_plane(camera, homography, around)
    area = abs(np.linalg.det(np.stack([right - left, bottom - top]) / 2.0))
    return float(min(1.0, _LONGEST_SIDE / max(height, width)) / np.sqrt(area))


def _on_plane(grey: Grey, camera: Camera, homography: FloatArray, scale: float) -> tuple[Grey, FloatArray]:
    """A picture drawn on the plane without its brightness, NaN outside; and where its corner lies, px."""
    outline = to_plane(camera, homography, camera.outline(16)) * scale
    middle = np.nanmedian(outline, axis=0)
    reach = _MOST_PX / 2.0 * _LONGEST_SIDE
    low, high = (
        np.clip(edge, middle - reach, middle + reach) for edge in (np.nanmin(outline, 0), np.nanmax(outline, 0))
    )
    origin = np.floor(low)
    width, height = np.maximum(np.ceil(high - origin).astype(int), 1)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    plane = (np.stack([u, v], axis=-1).reshape(-1, 2) + origin) / scale
    places = from_plane(camera, homography, plane).reshape(height, width, 2)
    # The picture is smaller on the plane than it is: without a blur it would alias.
    factor = max(1.0, max(grey.shape) / _LONGEST_SIDE)
    if factor > 1.05:
        grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), 0.5 * factor), dtype=np.float32)
    return _without_brightness(sampled(grey, places)), origin


def _without_brightness(picture: Grey) -> Grey:
    """What is finer than a blur, where the picture is."""
    seen = np.isfinite(picture)
    weight = cv2.GaussianBlur(seen.astype(np.float32), (0, 0), _COARSEST)
    coarse = cv2.GaussianBlur(np.where(seen, picture, np.float32(0)), (0, 0), _COARSEST) / np.maximum(weight, 1e-6)
    return np.where(seen, picture - coarse, np.float32(np.nan)).astype(np.float32)


def _correlation(first: Grey, second: Grey) -> tuple[FloatArray, NDArray[np.float64]]:
    """Normalized correlation at every position of the first picture in the second, and the px that overlap there."""
    shape = [a + b - 1 for a, b in zip(first.shape, second.shape, strict=True)]
    fast = [fft.next_fast_len(n, real=True) for n in shape]
    mask1, mask2 = np.isfinite(first)[::-1, ::-1], np.isfinite(second)
    values1, values2 = np.nan_to_num(first)[::-1, ::-1].astype(np.float64), np.nan_to_num(second).astype(np.float64)
    spectra = [fft.rfft2(values, fast) for values in (values1, values1**2, mask1, values2, values2**2, mask2)]
    a, aa, am, b, bb, bm = spectra
    products = [fft.irfft2(product, fast)[: shape[0], : shape[1]] for product in (a * b, aa * bm, am * bb, am * bm)]
    both, own1, own2, area = products
    norm = np.sqrt(np.maximum(own1, 0.0) * np.maximum(own2, 0.0))
    floor = 1e-6 * max(float(norm.max()), 1e-12)
    return np.where(norm > floor, both / np.maximum(norm, floor), 0.0), np.rint(area)
