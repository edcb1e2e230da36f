"""One image before anything is known of it: a file, a video frame or an array in memory."""

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import PIL.Image

from rdstitch.arrays import AnyArray
from rdstitch.choices import ChannelOrder
from rdstitch.errors import ArgumentError
from rdstitch.io.metadata import Metadata, metadata_of
from rdstitch.io.read import DecodedImage, as_image, from_pillow
from rdstitch.io.samples import split_alpha
from rdstitch.system.file_access import canonical_name, without_query


@dataclass(frozen=True, eq=False)
class DeferredImage:
    """An image that is read when it is needed, and is no file of its own: a plane of several, an array on a disk."""

    metadata: Metadata
    load: Callable[[], DecodedImage]


@dataclass(frozen=True, eq=False)
class Frame:
    """One input image."""

    path: Path  # its file; for an image that is no file of its own the name that stands for it
    number: int | None = None  # its number in the video, bag or list of arrays that it comes from, from 0
    timestamp: float | None = None  # when it was taken, s, where its video or bag knows that
    image: DecodedImage | DeferredImage | None = None  # the image itself; None: what is in its file
    header: Metadata | None = None  # of its file, where that was read already
    # its name among images of which another one has the same file name: with folders, as many as tell them apart
    label: str = ""

    @property
    def name(self) -> str:
        """Its name in messages, tables and files, the same in every locale."""
        return self.label or canonical_name(without_query(self.path).name)

    @property
    def metadata(self) -> Metadata | None:
        """Header of its file as far as that was read, or of the image itself."""
        return self.header if self.image is None else self.image.metadata

    def decoded(self) -> DecodedImage:
        """The image itself, where it is no file of its own."""
        assert self.image is not None
        return self.image.load() if isinstance(self.image, DeferredImage) else self.image


def frame_numbers(listed: Sequence[Frame | None]) -> list[int]:
    """The number of each in its video, bag or list of arrays, else its place among all that are listed."""
    return [place if frame is None or frame.number is None else frame.number for place, frame in enumerate(listed)]


Image = str | os.PathLike[str] | AnyArray | PIL.Image.Image
"""A file, whatever else stands for files (see :mod:`rdstitch.inputs.find`), or an image in memory."""

Images = Image | Iterable[Image | Frame]
"""One image or any number of them, an iterator for example."""

Named = str | os.PathLike[str] | Frame


def as_inputs(images: Images, channel_order: ChannelOrder = "bgr") -> list[Named]:
    """The list of what the user gave: names stay as they are, arrays become frames.

    A single path or array is one input. An array is of shape (H, W), (H, W, 1), (H, W, 3), or with alpha as the last
    channel (H, W, 2) or (H, W, 4), or of more bands, whose order stays; uint8, uint16 or floating point. An array of
    shape (N, H, W, C) is a sequence of N images. A Pillow image is in its own colours, whatever ``channel_order`` is,
    with its EXIF. The i-th input, if it is an array or such an image, is called ``image_000i``.
    """
    if channel_order not in get_args(ChannelOrder):
        raise ArgumentError(f"channel_order must be 'bgr' or 'rgb', not {channel_order!r}")
    listed: Iterable[Any]
    if isinstance(images, (str, os.PathLike, PIL.Image.Image)) or (isinstance(images, np.ndarray) and images.ndim != 4):
        listed = [images]
    elif isinstance(images, Iterable):
        listed = images
    else:
        raise ArgumentError(f"expected paths or arrays, not {type(images).__name__}")
    return [_as_input(item, index, channel_order) for index, item in enumerate(listed)]


def to_channel_order(samples: AnyArray, channel_order: ChannelOrder) -> AnyArray:
    """Samples (H, W), (H, W, C) in RGB order in the order wanted, or the other way round."""
    if channel_order == "rgb" or samples.ndim == 2 or samples.shape[2] != 3:
        return samples
    return np.asarray(cv2.cvtColor(samples, cv2.COLOR_BGR2RGB))


def files_of(frames: Iterable[Frame]) -> list[Path]:
    """The files among the frames, which must not be overwritten."""
    return [frame.path for frame in frames if frame.image is None]


def _as_input(item: Any, index: int, channel_order: ChannelOrder) -> Named:
    if isinstance(item, (str, os.PathLike, Frame)):
        return item
    if item is None:
        raise ArgumentError(
            f"image {index} is None, which cv2.imread returns for a file that it cannot read; check the name"
        )
    name = f"image_{index:04d}"
    if isinstance(item, PIL.Image.Image):
        samples, alpha = from_pillow(item)
        metadata = replace(metadata_of(item), bit_depth=8 * samples.itemsize)  # as Pillow shows it
        return Frame(Path(name), index, image=as_image(Path(name), samples, alpha, metadata))
    if not isinstance(item, np.ndarray):
        kind, remedy = type(item).__name__, "convert it by numpy.asarray"
        if type(item).__module__.partition(".")[0] == "torch":
            kind = "a tensor of torch"
            remedy = 'of shape (C, H, W) in RGB, give tensor.permute(1, 2, 0).numpy(force=True) and channel_order="rgb"'
        raise ArgumentError(f"image {index}: expected a path, a NumPy array or a Pillow image, not {kind}; {remedy}")
    return Frame(Path(name), index, image=array_as_image(name, item, channel_order))


def array_as_image(name: str, array: AnyArray, channel_order: ChannelOrder) -> DecodedImage:
    """An array as the readers of files give it: in RGB order, alpha apart, and a copy, since buffers are reused."""
    if array.ndim not in (2, 3) or array.size == 0:
        raise ArgumentError(f"{name}: expected an array of shape (H, W) or (H, W, C), not {array.shape}")
    array = array.astype(array.dtype.newbyteorder("="), copy=False)
    if array.dtype not in (np.uint8, np.uint16) and array.dtype.kind != "f":
        raise ArgumentError(f"{name}: expected uint8, uint16 or floating-point samples, not {array.dtype}")
    samples, alpha = split_alpha(array)
    if samples.shape[2:] == (1,):
        samples = samples[..., 0]
    samples = to_channel_order(
        np.array(samples, dtype=np.float32 if array.dtype.kind == "f" else array.dtype), channel_order
    )
    channels = 1 if array.ndim == 2 else array.shape[2]
    metadata = Metadata((array.shape[1], array.shape[0]), bit_depth=8 * array.dtype.itemsize, channels=channels)
    return as_image(Path(name), samples, None if alpha is None else alpha.copy(), metadata)
