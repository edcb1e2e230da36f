"""An image as detectors want it: grey, 8 bits, of working size, with the distance to what is masked."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError

PixelArray = NDArray[Any]
"""Pixels of uint8, uint16 or float."""

Mask = NDArray[Any]
"""A mask of bool or uint8."""

_STRETCH_PERCENTILES = (0.1, 99.9)
CLIP_LIMIT, _CLIP_TILES = 4.0, 8
"""Contrast-limited adaptive histogram equalization (Zuiderveld 1994): largest slope, and tiles along a side."""

Stretch = tuple[float, float]
"""The two grey levels that become 0 and 255."""


@dataclass(frozen=True, eq=False)
class View:
    """An image as it was loaded, whole or smaller."""

    image: PixelArray  # (height, width) or (height, width, bands), without alpha
    mask: Mask | None = None  # (height, width), bool: true or not zero where the image counts; None for everywhere
    reduction: int = 1  # blocks of so many pixels a side of the whole image are one pixel
    # width and height of the whole image, pixels; where it is not given, this is the whole
    image_size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.mask is not None and self.mask.shape != self.image.shape[:2]:
            raise ArgumentError(f"mask of shape {self.mask.shape} for an image of shape {self.image.shape[:2]}")

    @classmethod
    def of(cls, image: PixelArray, mask: Mask | None = None) -> Self:
        """A whole image, grey or RGB, whose last band of two or four is its alpha."""
        if image.ndim != 3 or image.shape[2] not in (2, 4):
            return cls(image, mask)
        view, shown = cls(image[..., :-1], mask), image[..., -1] > 0
        return replace(view, mask=shown if mask is None else shown & (mask != 0))

    @property
    def full_size(self) -> tuple[int, int]:
        """Width and height of the whole image, pixels."""
        return self.image_size or (self.image.shape[1], self.image.shape[0])


@dataclass(frozen=True, eq=False)
class PreparedImage:
    """A grey image of working size."""

    grey: NDArray[np.uint8]  # (height, width), uint8
    # (height, width), float32: distance to the nearest masked pixel, pixels of ``grey``, zero if masked; None without
    # mask
    clearance: NDArray[np.float32] | None
    factor: FloatArray  # (2,): pixels of the whole image for one of this, horizontally and vertically
    full_size: tuple[int, int]  # width and height, pixels

    @property
    def reduced(self) -> bool:
        """True where the working size is less than the full one."""
        return bool(self.factor.max() > 1.0)

    def covers(self, points: FloatArray, radius: FloatArray) -> NDArray[np.bool_]:
        """Test that discs (N, 2), (N,) keep clear of the mask; pixels of ``grey``."""
        if self.clearance is None:
            return np.ones(len(points), dtype=bool)
        height, width = self.clearance.shape
        u, v = np.clip(np.rint(points), 0, (width - 1, height - 1)).astype(np.intp).T
        clearance: NDArray[np.float32] = self.clearance[v, u]
        return clearance > radius

    def to_full_size(self, points: FloatArray) -> FloatArray:
        """Pixels of ``grey`` to pixels of the full-size image; (0, 0) is the centre of the first pixel in both."""
        return (points + 0.5) * self.factor - 0.5


def halving(image_size: tuple[int, int], megapixels: float) -> int:
    """The power of two that width and height are divided by for at most so many 10⁶ pixels."""
    (width, height), factor = image_size, 1
    # Sizes are rounded up, so that halving twice is dividing by four.
    while factor < max(image_size) and -(-width // factor) * -(-height // factor) > megapixels * 1e6:
        factor *= 2
    return factor


def prepare(
    view: View, work_megapixels: float | None, *, stretch: Stretch | None = None, equalize: bool = False
) -> PreparedImage:
    """Make an image ready for detection; see :func:`rdstitch.features.detect.detect` for what it may be."""
    image, mask = _checked(view.image), view.mask
    usable = _usable(image, mask)
    if image.ndim == 3 and image.shape[2] > 4:
        image = _grey(image)
    height, width = image.shape[:2]
    factor = 1 if work_megapixels is None else halving((width, height), work_megapixels)
    if factor > 1:
        size = (-(-width // factor), -(-height // factor))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        if usable is not None:
            # A pixel is usable if all that it was made of is.
            usable = cv2.resize(usable.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
    grey = _eight_bits(_grey(image), usable, stretch)
    if equalize:
        grey = np.asarray(cv2.createCLAHE(CLIP_LIMIT, (_CLIP_TILES, _CLIP_TILES)).apply(grey), np.uint8)
    shrink = view.reduction * np.array([width / grey.shape[1], height / grey.shape[0]])
    clearance = None
    if usable is not None:
        clearance = np.asarray(cv2.distanceTransform(usable.astype(np.uint8), cv2.DIST_L2, 5), np.float32)
    return PreparedImage(grey, clearance, shrink, view.full_size)


def _checked(image: PixelArray) -> PixelArray:
    """The image in the order of bytes of this machine, float32 where it is of any float."""
    image = np.asarray(image, image.dtype.newbyteorder("="))
    if image.ndim not in (2, 3) or image.size == 0:
        raise ArgumentError(f"expected an image of shape (height, width[, bands]), not {image.shape}")
    if image.dtype.kind != "f" and image.dtype not in (np.uint8, np.uint16):
        raise ArgumentError(f"expected an image of uint8, uint16 or float, not {image.dtype}")
    with np.errstate(over="ignore"):  # to inf, where nothing is detected
        return np.asarray(image, np.float32) if image.dtype.kind == "f" else image


def _usable(image: PixelArray, mask: Mask | None) -> NDArray[np.bool_] | None:
    """Combine mask and finiteness into where features are allowed; None for everywhere."""
    parts: list[NDArray[np.bool_]] = [] if mask is None else [mask != 0]
    if image.dtype.kind == "f":
        parts.append(np.asarray(np.isfinite(image.reshape(*image.shape[:2], -1)).all(axis=2)))
    parts = [part for part in parts if not part.all()]
    return np.logical_and.reduce(parts) if parts else None


def _grey(image: PixelArray) -> PixelArray:
    """The first of one or two bands, the luminance of the first three of three or four, the mean of more."""
    if image.ndim == 2:
        return image
    if image.shape[2] < 3:
        return np.ascontiguousarray(image[..., 0])
    if image.shape[2] > 4:
        mean: PixelArray = image.mean(axis=2, dtype=np.float32)
        return mean if image.dtype.kind == "f" else np.rint(mean).astype(image.dtype)
    return cv2.cvtColor(image[..., :3], cv2.COLOR_RGB2GRAY)


def usual_stretch(view: View) -> Stretch | None:
    """The stretch that uses 8 bits best for one image; None where all of it is masked."""
    image = _checked(view.image)
    return _stretch(_grey(image), _usable(image, view.mask))


def common_stretch(usual: Iterable[Stretch | None]) -> Stretch | None:
    """The stretch for all images of a set; a tenth of them may be darker, or brighter, than the rest."""
    stretches = np.array([stretch for stretch in usual if stretch is not None])
    if not len(stretches):
        return None
    return float(np.quantile(stretches[:, 0], 0.1)), float(np.quantile(stretches[:, 1], 0.9))


def _stretch(grey: PixelArray, usable: NDArray[np.bool_] | None) -> Stretch | None:
    """Stretch percentiles of the part that is used, not single hot pixels."""
    inside = grey if usable is None else grey[usable]
    if inside.size == 0:
        return None
    low, high = np.percentile(inside, _STRETCH_PERCENTILES).tolist()
    return low, high


def _eight_bits(grey: PixelArray, usable: NDArray[np.bool_] | None, stretch: Stretch | None) -> NDArray[np.uint8]:
    """Stretch images to 8 bits, those that have no more only by a given stretch."""
    if grey.dtype == np.uint8 and stretch is None:
        return np.ascontiguousarray(grey, dtype=np.uint8)
    stretch = stretch or _stretch(grey, usable)
    if stretch is None:
        return np.zeros(grey.shape, dtype=np.uint8)
    low, high = stretch
    finite = np.where(np.isfinite(grey), grey, low)
    scaled = (finite - low) * (255.0 / max(high - low, 1e-12))
    return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)
