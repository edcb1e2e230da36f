"""From files to the tiles in them: folders of positions, series, channels, z planes and times."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rdstitch.choices import ZPlane
from rdstitch.errors import ArgumentError
from rdstitch.inputs.frame import Frame, Named
from rdstitch.inputs.image_folders import READABLE_SUFFIXES, natural_key
from rdstitch.io.metadata import Metadata
from rdstitch.io.read import DecodedImage, as_image
from rdstitch.io.stored_tiles import StoredTile, stored_tiles
from rdstitch.results.messages import Message


def with_position_folders(inputs: Sequence[Named]) -> list[Named]:
    """The inputs; a folder without images of its own stands for those of its folders that have some."""
    found: list[Named] = []
    for item in inputs:
        folder = None if isinstance(item, Frame) or not Path(item).is_dir() else Path(item)
        if folder is None or _has_images(folder):
            found.append(item)
            continue
        inner = sorted((part for part in folder.iterdir() if part.is_dir()), key=natural_key)
        found += [part for part in inner if _has_images(part)] or [item]
    return found


def _has_images(folder: Path) -> bool:
    return any(part.suffix.lower() in READABLE_SUFFIXES for part in folder.iterdir())


def tile_frames(
    frames: Sequence[Frame], z: ZPlane | None, time: int | None
) -> tuple[list[Frame], dict[Path, StoredTile], list[Message]]:
    """The tiles in files, one frame each; what their files say of them, by path; and what is not taken of these.

    Of several z planes the brightest sample counts, and of several times the first, unless others are chosen.
    """
    files = [frame.path for frame in frames if frame.image is None and frame.load is None]
    stored = {tile.name: tile for tile in stored_tiles(files)}
    known = {frame.path: frame for frame in frames}
    tiles = [frame for frame in frames if frame.path not in set(files)]
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
    return Frame(tile.name, load=partial(_load, tile, z, time, metadata), metadata=metadata)


def _load(tile: StoredTile, z: ZPlane, time: int, metadata: Metadata) -> DecodedImage:
    return as_image(tile.name, *tile.read(z, time), metadata)
