"""Tiles as a user gives them: files and what is in them, folders of positions, arrays, or one array of all."""

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from rdstitch.choices import ZPlane
from rdstitch.errors import ArgumentError
from rdstitch.inputs.frame import DeferredImage, Frame, Named, array_as_image, as_inputs, files_of
from rdstitch.inputs.image_folders import images_in, natural_key
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import DecodedImage, as_image
from rdstitch.io.stored_tiles import StoredTile, stored_tiles
from rdstitch.results.messages import Message


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

    return Frame(name, index, image=DeferredImage(metadata, load))


def with_position_folders(inputs: Sequence[Named]) -> list[Named]:
    """The inputs; a folder without images of its own stands for those of its folders that have some."""
    named: list[Named] = []
    for item in inputs:
        folder = None if isinstance(item, Frame) or not Path(item).is_dir() else Path(item)
        if folder is None or images_in(folder):
            named.append(item)
            continue
        inner = [part for part in folder.iterdir() if part.is_dir() and not part.name.startswith(".")]
        named += [part for part in sorted(inner, key=natural_key) if images_in(part)] or [item]
    return named


def tile_frames(
    frames: Sequence[Frame], z: ZPlane | None, time: int | None
) -> tuple[list[Frame], dict[Path, StoredTile], list[Message]]:
    """The tiles in files, one frame each; what their files say of them, by path; and what is not taken of these.

    Of several z planes the brightest sample counts, and of several times the first, unless others are chosen.
    """
    files = files_of(frames)
    stored = {tile.name: tile for tile in stored_tiles(files)}
    known = {frame.path: frame for frame in frames}
    tiles = list(frames)
    if not all(tile.is_plain for tile in stored.values()):
        in_files = set(files)
        tiles = [frame for frame in frames if frame.path not in in_files]
        tiles += [
            known[tile.name] if tile.is_plain else _frame(tile, "max" if z is None else z, time or 0)
            for tile in stored.values()
        ]
    depth, times = (max((tile.counts[k] for tile in stored.values()), default=1) for k in (1, 2))
    notes = []
    if depth > 1 and z is None:
        notes.append(f"files hold {depth} z planes: of each pixel the brightest is taken; --z N takes one plane")
    if times > 1 and time is None:
        notes.append(f"files hold {times} times: the first is taken; --time N takes another")
    for what, wanted, count in (("z plane", z, depth), ("time", time, times)):
        if wanted not in (None, "max", 0) and count == 1:
            raise ArgumentError(f"no file has a {what} with the number {wanted}: each has one, 0")
    return tiles, stored, [Message(text, severity="note") for text in notes]


def _frame(tile: StoredTile, z: ZPlane, time: int) -> Frame:
    channels, depth, times = tile.counts
    for what, wanted, count in (("z planes", z, depth), ("times", time, times)):
        if wanted != "max" and not 0 <= wanted < count:
            raise ArgumentError(f"{tile.name}: has {count} {what}, none with the number {wanted}")
    size, bits, samples = tile.first_page()
    metadata = Metadata(
        size,
        bit_depth=bits,
        channels=channels if channels > 1 else samples,
        pixel_size=tile.pixel_size,
        planes=channels > 1,
        channel_names=tile.channel_names,
    )
    return Frame(tile.name, image=DeferredImage(metadata, partial(_load, tile, z, time, metadata)))


def _load(tile: StoredTile, z: ZPlane, time: int, metadata: Metadata) -> DecodedImage:
    return as_image(tile.name, *tile.read(z, time), metadata)
