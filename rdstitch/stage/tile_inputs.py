"""Tiles as a user gives them: files, arrays of NumPy, Dask or Zarr, or one array of all."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from rdstitch.errors import ArgumentError
from rdstitch.inputs.frame import Frame, Named, array_as_image, as_inputs
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import DecodedImage, as_image
from rdstitch.stage.tile_frames import with_position_folders


def as_tiles(inputs: Any) -> list[Named]:
    """What the user gave as a list of files and images."""
    if not isinstance(inputs, str | os.PathLike | PIL.Image.Image) and getattr(inputs, "ndim", 0) in (3, 4):
        inputs = [inputs[k] if isinstance(inputs, np.ndarray) else _Part(inputs, k) for k in range(inputs.shape[0])]
    if isinstance(inputs, str | os.PathLike | PIL.Image.Image):
        return with_position_folders(as_inputs(inputs))
    return with_position_folders(as_inputs([_as_tile(item, index) for index, item in enumerate(inputs)]))


class _Part:
    """One tile of an array of all, which is read when it is needed."""

    def __init__(self, whole: Any, index: int) -> None:
        self._whole, self._index = whole, index
        self.shape, self.dtype = tuple(whole.shape[1:]), whole.dtype

    def __array__(self, dtype: Any = None, copy: Any = None) -> NDArray[Any]:
        """The tile in memory."""
        return np.asarray(self._whole[self._index])


def _as_tile(item: Any, index: int) -> Any:
    """An array whose channels come first, or that is not in memory, which is read when it is needed; others stay."""
    if isinstance(item, str | os.PathLike | PIL.Image.Image | Frame) or not hasattr(item, "shape"):
        return item
    shape, name = tuple(item.shape), Path(f"image_{index:04d}")
    planes = len(shape) == 3 and shape[0] < min(shape[1:])
    if isinstance(item, np.ndarray) and not planes:
        return item
    if len(shape) not in (2, 3):
        raise ArgumentError(f"tile {index}: expected an array of two or three dimensions, not of shape {shape}")
    height, width, *channels = (*shape[1:], shape[0]) if planes else shape
    bits = 8 * np.dtype(item.dtype).itemsize
    metadata = Metadata((width, height), bit_depth=bits, channels=(channels or [1])[0], planes=planes)

    def load() -> DecodedImage:
        samples = np.asarray(item)
        if planes:
            return as_image(name, np.moveaxis(samples, 0, -1), None, metadata)
        return array_as_image(str(name), samples, "bgr")

    return Frame(name, index, load=load, metadata=metadata)
