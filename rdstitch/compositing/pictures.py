"""Pictures read when their tiles come, smoothed for the output's resolution, in a cache of bounded size."""

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from threading import Lock
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.errors import InputError
from rdstitch.io.read import Picture

Source = Callable[[], Picture]

_OPAQUE_FROM = 128
# A picture that gets smaller by less than this keeps its pixels as they are.
_NEGLIGIBLE_SHRINK = 1.05
# Share of the shorter side over which the weight rises from the border of a mask.
_MASK_FEATHER = 0.125


@dataclass(frozen=True)
class LoadedPicture:
    """A picture ready to be resampled.

    Attributes
    ----------
    pixels : ndarray of shape (h, w) or (h, w, C)
        uint8, uint16 or float32; transparent pixels are filled from their nearest neighbours.
    opacity : ndarray of shape (h, w), float32, or None
        0 where the picture is masked out, else rising to 1 with the distance from the mask.
    opacity_step : float
        Opacity of the last opaque pixel beside a transparent one.
    reduction : int
        The picture is smaller than the original by this factor.
    """

    pixels: NDArray[Any]
    opacity: NDArray[np.float32] | None = None
    opacity_step: float = 1.0
    reduction: int = 1

    @property
    def nbytes(self) -> int:
        """Memory that it takes, bytes."""
        return self.pixels.nbytes + (0 if self.opacity is None else self.opacity.nbytes)


def prepare_picture(picture: Picture, shrink: float) -> LoadedPicture:
    """Fill what is transparent, and smooth the picture to what an output that shrinks it can show.

    Parameters
    ----------
    picture : Picture
    shrink : float
        Picture px per output px. From 4 on, the picture is averaged over whole blocks first; a Gaussian does the rest.
    """
    pixels, opaque = picture.pixels, None
    if picture.alpha is not None:
        opaque = picture.alpha >= _OPAQUE_FROM
        pixels = _filled(pixels, opaque)
    # Blocks alone alias; a Gaussian on at least two px per output px does not.
    reduction = max(1, int(shrink / 2))
    if reduction > 1:
        pixels = _block_mean(pixels, reduction)
        opaque = None if opaque is None else _block_mean(opaque.astype(np.float32), reduction) > 0.999
    rest = shrink / reduction
    if rest > _NEGLIGIBLE_SHRINK:
        sigma = 0.5 * math.sqrt(rest**2 - 1.0)
        pixels = cv2.GaussianBlur(pixels, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
    if opaque is None:
        return LoadedPicture(pixels, reduction=reduction)
    opacity, step = _opacity(opaque)
    return LoadedPicture(pixels, opacity, step, reduction)


def _filled(pixels: NDArray[Any], opaque: NDArray[np.bool_]) -> NDArray[Any]:
    """Every transparent pixel gets the value of the nearest opaque one, so that no kernel mixes in its colour."""
    if not opaque.any():
        return pixels
    _, labels = cv2.distanceTransformWithLabels(
        (~opaque).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    position = np.zeros(int(labels.max()) + 1, dtype=np.intp)
    position[labels[opaque]] = np.flatnonzero(opaque)
    flat = pixels.reshape(-1, *pixels.shape[2:])
    return np.ascontiguousarray(flat[position[labels]])


def _block_mean(pixels: NDArray[Any], factor: int) -> NDArray[Any]:
    """Mean over blocks of ``factor`` x ``factor`` px; the last block is completed by repetition."""
    height, width = pixels.shape[:2]
    down, right = -height % factor, -width % factor
    whole = cv2.copyMakeBorder(pixels, 0, down, 0, right, cv2.BORDER_REPLICATE) if down or right else pixels
    size = ((width + right) // factor, (height + down) // factor)
    done = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
    return np.asarray(done).reshape(size[1], size[0], *pixels.shape[2:])


def _opacity(opaque: NDArray[np.bool_]) -> tuple[NDArray[np.float32], float]:
    """Weight that rises from a mask's border, and its value at the first opaque pixel."""
    reach = max(2.0, _MASK_FEATHER * min(opaque.shape))
    distance = cv2.distanceTransform(opaque.astype(np.uint8), cv2.DIST_L2, 5)
    return np.minimum(np.asarray(distance, dtype=np.float32) / np.float32(reach), np.float32(1.0)), 1.0 / reach


class PictureReader:
    """Reads pictures, and sees to it that they are what was registered.

    Parameters
    ----------
    sources : sequence of callables
        Each reads one picture.
    sizes : sequence of (int, int)
        Width and height, px, that each picture must have.
    """

    def __init__(self, sources: Sequence[Source], sizes: Sequence[tuple[int, int]]) -> None:
        self._sources, self._sizes = sources, sizes
        self._samples: tuple[tuple[int, ...], np.dtype[Any]] | None = None
        self._masked: dict[int, bool] = {}

    def __call__(self, index: int) -> Picture:
        """Read picture ``index``; a grey picture among coloured ones becomes coloured.

        Raises
        ------
        InputError
            When it cannot be read, has another size than its camera, or samples unlike the first picture's.
        """
        picture = self._sources[index]()
        height, width = picture.pixels.shape[:2]
        if (width, height) != self._sizes[index]:
            expected = "{} x {}".format(*self._sizes[index])
            raise InputError(f"picture {index + 1} has {width} x {height} px, but its camera has {expected}")
        if self._samples is None:
            self._samples = picture.pixels.shape[2:], picture.pixels.dtype
        channels, dtype = self._samples
        pixels = picture.pixels
        if pixels.ndim == 2 and channels == (3,):
            pixels = np.repeat(pixels[..., None], 3, axis=2)
        elif pixels.shape[2:] == (3,) and channels == ():
            pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        if (pixels.shape[2:], pixels.dtype) != (channels, dtype):
            raise InputError(
                f"picture {index + 1} has {_kind(pixels.shape[2:], pixels.dtype)}, but the first that was read has "
                f"{_kind(channels, dtype)}; convert them to one kind"
            )
        self._masked[index] = picture.alpha is not None
        return replace(picture, pixels=pixels)

    def masked(self, index: int) -> bool:
        """Whether a picture has transparent parts; reads it when that is not known yet."""
        if index not in self._masked:
            self(index)
        return self._masked[index]

    @property
    def samples(self) -> tuple[int, np.dtype[Any]]:
        """Number of channels and type of all pictures' samples; reads the first one when none has been read."""
        if self._samples is None:
            self(0)
        assert self._samples is not None
        channels, dtype = self._samples
        return (channels[0] if channels else 1), dtype


def _kind(channels: tuple[int, ...], dtype: np.dtype[Any]) -> str:
    """Samples in words."""
    return f"{channels[0] if channels else 1} channel(s) of {dtype}"


class PictureCache:
    """The pictures used last, prepared for resampling, in at most ``limit`` bytes (though always one).

    Parameters
    ----------
    reader : PictureReader
    shrinks : sequence of float
        Picture px per output px.
    limit : int
        Bytes.
    """

    def __init__(self, reader: PictureReader, shrinks: Sequence[float], limit: int) -> None:
        self._reader, self._shrinks, self._limit = reader, shrinks, limit
        self._held: OrderedDict[int, LoadedPicture] = OrderedDict()
        self._bytes = self._largest = 0
        # One picture is read at a time; meanwhile those that are held can be had.
        self._lock, self._reading = Lock(), Lock()

    def masked(self, index: int) -> bool:
        """Whether a picture has transparent parts."""
        return self._reader.masked(index)

    def __getitem__(self, index: int) -> LoadedPicture:
        """Picture ``index``, read unless it is held; may be asked for from several threads."""
        if (held := self._find(index)) is not None:
            return held
        with self._reading:
            # Another thread may have read it in the meantime.
            if (held := self._find(index)) is not None:
                return held
            # Room is made before reading, so that the limit holds meanwhile too.
            with self._lock:
                while self._held and self._bytes + self._largest > self._limit:
                    _, dropped = self._held.popitem(last=False)
                    self._bytes -= dropped.nbytes
                    del dropped
            loaded = prepare_picture(self._reader(index), self._shrinks[index])
            with self._lock:
                self._largest = max(self._largest, loaded.nbytes)
                self._bytes += loaded.nbytes
                self._held[index] = loaded
            return loaded

    def _find(self, index: int) -> LoadedPicture | None:
        """A picture that is held."""
        with self._lock:
            if index not in self._held:
                return None
            self._held.move_to_end(index)
            return self._held[index]
