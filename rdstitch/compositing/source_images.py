"""One registered image as the tiles need it: of one kind, with nothing transparent, smoothed for the output."""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import AnyArray, FloatArray
from rdstitch.compositing.transparency import OPACITY_BYTES, filled, opacity
from rdstitch.errors import InputError
from rdstitch.geometry.camera import Camera
from rdstitch.io.radiometric_tags import Radiometry
from rdstitch.io.read import DecodedImage
from rdstitch.io.reduction import block_mean, fitting_reduction, reduced_size

_OPAQUE_FROM = 128  # alpha
_NEGLIGIBLE_SHRINK = 1.05  # an image that gets smaller by less than this keeps its pixels as they are
# Pixels read for one of the output, at least: a Gaussian needs nearly two to smooth them.
_PIXELS_PER_OUTPUT_PIXEL = 1.9
_PROBE_REDUCTION = 8  # at which an image is read only to learn its samples and whether it is masked

ImageLoader = Callable[[int], DecodedImage]
"""Reads an image reduced by a factor, of which large ones are quicker; see :func:`rdstitch.io.read.read_image`."""

Displacement = Callable[[FloatArray], FloatArray]
"""Displacement of an image's content, pixels (..., 2), at measured pixels (..., 2): what local alignment found."""


@dataclass(frozen=True, eq=False)
class PlacedImage:
    """An image and its place."""

    read: ImageLoader  # called in other threads, before its tiles come, and perhaps again
    camera: Camera
    homography: FloatArray  # (3, 3): normalized undistorted coordinates to plane coordinates, or to directions
    # as the camera wrote it down (time x sensitivity / f-number²), up to a factor common to all images
    exposure: float | None = None
    # what local alignment adds to its measured pixels; see :class:`rdstitch.compositing.warp.Warp`
    displacement: Displacement | None = None
    path: str = ""  # what messages call it; its number if empty
    radiometry: Radiometry | None = None  # of samples that are measurements
    coloured: bool = False  # whether its file says that it has colours, so that grey ones beside it get them
    transparent: bool = False  # whether parts of it may be transparent, by what is known before it is read


@dataclass(frozen=True, eq=False)
class LoadedImage:
    """An image ready to be resampled."""

    # (h, w) or (h, w, C): uint8, uint16 or float32; transparent pixels are filled from their nearest neighbours
    pixels: AnyArray
    # (h, w), uint16: 0 where the image is masked out, else rising to OPAQUE with the distance from the mask
    opacity: NDArray[np.uint16] | None = None
    opacity_step: float = 1.0  # opacity of the last opaque pixel beside a transparent one, as a share of OPAQUE
    reduction: int = 1  # the image is smaller than the original by this factor

    @property
    def nbytes(self) -> int:
        """Memory that it takes, bytes."""
        return self.pixels.nbytes + (0 if self.opacity is None else self.opacity.nbytes)


@dataclass(frozen=True)
class ImageOnDisk:
    """An image ready to be resampled, in a file."""

    file: Path  # its pixels, then its opacity, as they are in memory
    arrays: Sequence[tuple[np.dtype[Any], tuple[int, ...]]]  # of these
    outline: LoadedImage  # what else is known of it

    @classmethod
    def write(cls, image: LoadedImage, file: Path) -> Self:
        """Keep an image in a file."""
        arrays = [image.pixels] if image.opacity is None else [image.pixels, image.opacity]
        try:
            with file.open("wb") as stream:
                for array in arrays:
                    np.ascontiguousarray(array).tofile(stream)
        except OSError:
            file.unlink(missing_ok=True)
            raise
        outline = replace(image, pixels=image.pixels[:0], opacity=None)
        return cls(file, [(array.dtype, array.shape) for array in arrays], outline)

    def mapped(self) -> LoadedImage:
        """The image, whose pixels are read from the file when they are used."""
        arrays, start = [], 0
        for dtype, shape in self.arrays:
            arrays.append(np.memmap(self.file, dtype, "r", start, shape))
            start += arrays[-1].nbytes
        return replace(self.outline, pixels=arrays[0], opacity=arrays[1] if len(arrays) > 1 else None)

    def remove(self) -> None:
        """Remove the file; what is mapped stays."""
        with suppress(OSError):
            self.file.unlink()


def prepare_image(image: DecodedImage, shrink: float, reduction: int = 1) -> LoadedImage:
    """Fill what is transparent, and smooth the image to what an output that shrinks it can show.

    It was read smaller by ``reduction``. Where the output shrinks it 4 times or more, whole blocks are averaged first;
    a Gaussian does the rest.
    """
    pixels, opaque = image.pixels, None
    if image.alpha is not None:
        opaque = image.alpha >= _OPAQUE_FROM
        pixels = filled(pixels, opaque)
    del image  # as large as all that is left of it
    pixels, smaller = smoothed(pixels, shrink, reduction)
    if smaller > reduction and opaque is not None:
        opaque = block_mean(opaque.astype(np.float32), smaller // reduction) > 0.999
    reduction = smaller
    if opaque is None:
        return LoadedImage(pixels, reduction=reduction)
    return LoadedImage(pixels, *opacity(opaque), reduction)


def block_side(shrink: float) -> int:
    """Pixels along a side that become one before an image is shrunk so much.

    Blocks alone alias; a Gaussian on at least two pixels per output pixel does not.
    """
    return max(1, int(shrink / 2))


def smoothed(pixels: AnyArray, shrink: float, reduction: int = 1) -> tuple[AnyArray, int]:
    """Pixels without what an output that shrinks them cannot show, and what they are smaller by than the original."""
    if (further := block_side(shrink / reduction)) > 1:
        pixels = block_mean(pixels, further)
        reduction *= further
    rest = shrink / reduction
    if rest > _NEGLIGIBLE_SHRINK:
        sigma = 0.5 * math.sqrt(rest**2 - 1.0)
        pixels = np.asarray(cv2.GaussianBlur(pixels, (0, 0), sigma, borderType=cv2.BORDER_REFLECT))
    return pixels, reduction


class ImageReader:
    """Reads images, and sees to it that they are what was registered."""

    def __init__(self, images: Sequence[PlacedImage]) -> None:
        self._images = images
        # Channels, sample type and name of the image that was read first.
        self._samples: tuple[tuple[int, ...], np.dtype[Any], str] | None = None
        self._masked: dict[int, bool] = {}
        self._coloured = any(image.coloured for image in images)

    def part(self, images: Sequence[int]) -> "ImageReader":
        """A reader of some of the images, which knows of them what this one does."""
        part = ImageReader([self._images[index] for index in images])
        part._samples, part._coloured = self._samples, self._coloured
        part._masked = {new: self._masked[old] for new, old in enumerate(images) if old in self._masked}
        return part

    def prepared(self, index: int, shrink: float) -> LoadedImage:
        """Read image ``index``, no larger than needed, for an output that shrinks it so much."""
        return self.prepared_twice(index, shrink, shrink)[0]

    def prepared_twice(self, index: int, shrink: float, finer: float) -> tuple[LoadedImage, LoadedImage]:
        """Read image ``index`` once for two outputs, of which the second shrinks it less."""
        reduction = _reading_reduction(finer)
        image = self(index, reduction)
        coarse = prepare_image(image, shrink, reduction)
        return coarse, coarse if finer == shrink else prepare_image(image, finer, reduction)

    def nbytes(self, index: int, shrink: float) -> int:
        """Memory that image ``index`` takes at most when it is prepared for such an output, if it was read before."""
        channels, dtype = self.samples
        width, height = reduced_size(self._images[index].camera.image_size, _reading_reduction(shrink))
        opacity = OPACITY_BYTES if self._masked.get(index, False) else 0
        return width * height * (channels * dtype.itemsize + opacity)

    def __call__(self, index: int, reduction: int = 1) -> DecodedImage:
        """Read image ``index``; a grey image among coloured ones becomes coloured."""
        placed = self._images[index]
        called = placed.path or f"image {index + 1}"
        image = placed.read(reduction)
        height, width = image.pixels.shape[:2]
        wanted = reduced_size(placed.camera.image_size, reduction)
        if (width, height) != wanted:
            expected = "{} x {}".format(*wanted)
            raise InputError(f"{called}: has {width} x {height} pixels, but its camera has {expected}")
        if self._samples is None:
            colours = (3,) if self._coloured and image.pixels.ndim == 2 else image.pixels.shape[2:]
            self._samples = colours, image.pixels.dtype, Path(called).name
        channels, dtype, first = self._samples
        pixels = image.pixels
        if pixels.ndim == 2 and channels == (3,):
            pixels = np.repeat(pixels[..., None], 3, axis=2)
        elif pixels.shape[2:] == (3,) and channels == ():
            pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        if (pixels.shape[2:], pixels.dtype) != (channels, dtype):
            kind, expected = _kind(pixels.shape[2:], pixels.dtype), _kind(channels, dtype)
            raise InputError(f"{called}: has {kind}, but {first} has {expected}; convert them to one kind")
        self._masked[index] = image.alpha is not None
        return replace(image, pixels=pixels)

    def masked(self, index: int) -> bool:
        """Whether an image has transparent parts; reads it when that is not known yet."""
        if index not in self._masked:
            self(index, _PROBE_REDUCTION)
        return self._masked[index]

    @property
    def samples(self) -> tuple[int, np.dtype[Any]]:
        """Number of channels and type of all images' samples; reads the first one when none has been read."""
        if self._samples is None:
            self(0, _PROBE_REDUCTION)
        assert self._samples is not None
        channels, dtype, _ = self._samples
        return (channels[0] if channels else 1), dtype


def _reading_reduction(shrink: float) -> int:
    """What an image is read smaller by for an output that shrinks it so much; a Gaussian does the rest."""
    return fitting_reduction(shrink / _PIXELS_PER_OUTPUT_PIXEL)


def _kind(channels: tuple[int, ...], dtype: np.dtype[Any]) -> str:
    """Samples in words; grey becomes colour where it must."""
    return f"{dtype} samples" + ("" if channels in ((), (3,)) else f" in {channels[0]} bands")
