"""What microscopes' programs write: which pages of which files are one tile, and where its stage was.

OME-TIFF (one file, or a set whose every file carries the XML of all), ImageJ's hyperstacks, Micro-Manager's stacks and
its folders of single images beside a ``metadata.txt``, and TIFF files of several pages.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from rdstitch.arrays import AnyArray, UInt8Array
from rdstitch.choices import ZPlane
from rdstitch.errors import InputError
from rdstitch.io.ome import MICROMETRES, Page, ome_pixel_size, ome_planes, ome_tree
from rdstitch.io.opening import TIFF_MAGIC, decoding
from rdstitch.io.read_tiff import image_pages, read_page
from rdstitch.system.file_access import canonical_name, canonical_text, open_regular, read_text
from rdstitch.system.late_imports import tifffile

_FOLDER_METADATA = "metadata.txt"
_LEADING = {"C": "C", "Z": "Z", "T": "T", "I": "Z", "Q": "Z"}  # what axes of tifffile are; unknown ones are taken for z


@dataclass(frozen=True)
class StoredTile:
    """One tile in its files."""

    name: Path  # its file; with a number where the file has several, and the folder where that is one
    # (channel, z, time) of every plane, and where it is
    planes: Mapping[tuple[int, int, int], Page]
    position: tuple[float, float] | None = None  # of the stage
    unit: float | None = None  # micrometres that the position counts; None for pixels
    pixel_size: float | None = None  # micrometres
    channel_names: tuple[str, ...] = ()

    @property
    def counts(self) -> tuple[int, int, int]:
        """Number of channels, of z planes and of times."""
        channels, depth, times = (max(index) + 1 for index in zip(*self.planes, strict=True))
        return channels, depth, times

    @property
    def is_plain(self) -> bool:
        """Whether it is what any reader makes of its file."""
        return list(self.planes.values()) == [Page(self.name, 0)]

    def read(self, z: ZPlane, time: int) -> tuple[AnyArray, UInt8Array | None]:
        """Samples (h, w), or (h, w, C) of several channels, and alpha, of a z plane or the brightest of all."""
        channels, depth, _ = self.counts
        wanted = range(depth) if z == "max" else [z]
        alpha = None
        with ExitStack() as stack:
            opened: dict[Path, tifffile.TiffFile] = {}
            levels = []
            for channel in range(channels):
                slices = []
                for level in wanted:
                    page = self.planes.get((channel, level, time))
                    if page is None:
                        raise InputError(f"{self.name}: lacks channel {channel} of z plane {level} at time {time}")
                    with decoding(page.file):
                        if page.file not in opened:
                            stream = stack.enter_context(open_regular(page.file))
                            opened[page.file] = stack.enter_context(_tiff(stream, page.file))
                        samples, alpha = _samples(opened[page.file], page.number)
                    slices.append(samples)
                levels.append(slices[0] if len(slices) == 1 else np.maximum.reduce(slices))
        if len(levels) == 1:
            return levels[0], alpha if len(wanted) == 1 else None
        if any(level.ndim != 2 or level.shape != levels[0].shape for level in levels):
            raise InputError(f"{self.name}: its channels are not all grey and of one size")
        return np.stack(levels, axis=-1), None

    def first_page(self) -> tuple[tuple[int, int], int, int]:
        """Width and height, bits and samples of a pixel, by the header of the first page."""
        page = self.planes[min(self.planes)]
        with decoding(page.file), open_regular(page.file) as stream, _tiff(stream, page.file) as tiff:
            first = tiff.pages[page.number if page.number < len(tiff.pages) else 0].aspage()
            return (first.imagewidth, first.imagelength), int(first.bitspersample), int(first.samplesperpixel)


def _tiff(stream: Any, file: Path) -> "tifffile.TiffFile":
    return tifffile.TiffFile(stream, name=str(file))


def _samples(tiff: "tifffile.TiffFile", number: int) -> tuple[AnyArray, UInt8Array | None]:
    if number < len(tiff.pages):
        return read_page(tiff, tiff.pages[number].aspage())
    # ImageJ writes large stacks behind one directory.
    stack = tiff.series[0].asarray()
    return np.asarray(stack.reshape(-1, *stack.shape[-2:])[number]), None


def stored_tiles(files: Iterable[Path]) -> list[StoredTile]:
    """The tiles that files hold, in their order; those of other formats are a tile each."""
    by_first_page: dict[object, StoredTile] = {}
    folders: dict[Path, dict[str, StoredTile]] = {}
    for file in files:
        if file.parent not in folders:
            folders[file.parent] = _micro_manager_folder(file.parent)
        listed = folders[file.parent].get(canonical_name(file.name))
        try:
            tiles = [listed] if listed is not None and len(listed.planes) > 1 else _of_file(file)
        except (InputError, OSError):
            # Whoever reads the file says what is wrong with it.
            tiles = [StoredTile(file, {(0, 0, 0): Page(file, 0)})]
        for tile in tiles:
            if tile.position is None and listed is not None:
                tile = replace(tile, position=listed.position, unit=listed.unit, pixel_size=listed.pixel_size)
            by_first_page.setdefault(tile.planes[min(tile.planes)], tile)
    return list(by_first_page.values())


def _of_file(file: Path) -> list[StoredTile]:
    plain = StoredTile(file, {(0, 0, 0): Page(file, 0)})
    with decoding(file), open_regular(file) as stream:
        if stream.read(4) not in TIFF_MAGIC:
            return [plain]
        stream.seek(0)
        with _tiff(stream, file) as tiff:
            if tiff.is_ome and (tiles := _ome(file, tiff)):
                return tiles
            if _micro_manager_tag(tiff.pages.first) is None:
                return [_stack(plain, tiff)]
            tags = enumerate(map(_micro_manager_tag, tiff.pages))
            return [_micro_manager(file, [(Page(file, k), tag) for k, tag in tags if tag])]


def _stack(plain: StoredTile, tiff: "tifffile.TiffFile") -> StoredTile:
    """A file of several pages by its shape; without further ones, such as masks and overviews."""
    if not tiff.is_imagej and len(list(islice(image_pages(tiff), 2))) < 2:
        return plain
    series = tiff.series[0]
    leading = [
        (_LEADING.get(axis, "Z"), n) for axis, n in zip(series.axes, series.shape, strict=True) if axis not in "YXS"
    ]
    count = math.prod(n for _, n in leading)
    if count < 2:
        return plain
    planes = {}
    pages = [page.index for page in series.pages if page is not None]
    # ImageJ's stacks may have one directory for all planes.
    numbers = pages if len(pages) == count else range(count)
    for number, index in zip(numbers, np.ndindex(*(n for _, n in leading)), strict=True):
        at = {axis: k for (axis, _), k in zip(leading, index, strict=True)}
        planes[at.get("C", 0), at.get("Z", 0), at.get("T", 0)] = Page(plain.name, number)
    size, about = None, tiff.imagej_metadata or {}
    unit = str(about.get("unit", ""))
    # ImageJ escapes letters beyond ASCII, as \u00B5m.
    unit_size = MICROMETRES.get(unit.encode().decode("unicode_escape", "ignore") if "\\u" in unit else unit)
    resolution = tiff.pages.first.tags.get("XResolution")
    if unit_size and resolution is not None and min(resolution.value) > 0:
        size = resolution.value[1] / resolution.value[0] * unit_size
    return replace(plain, planes=planes, pixel_size=size)


def _ome(file: Path, tiff: "tifffile.TiffFile") -> list[StoredTile]:
    """The images of OME-XML that have a plane in a file."""
    root = ome_tree(tiff.ome_metadata)
    if root is None:
        return []
    uuid, elsewhere = root.get("UUID", ""), root.find("BinaryOnly")
    if elsewhere is not None:
        root = ome_tree(_companion(file.parent / str(elsewhere.get("MetadataFile", ""))))
        if root is None:
            return []
    known = {element.get("FileName"): (element.text or "").strip() for element in root.iter("UUID")}
    by_name = file.name in known
    tiles = []
    for image in root.findall("Image"):
        if (pixels := image.find("Pixels")) is not None:
            planes = ome_planes(file, len(tiff.pages), pixels, None if by_name else uuid)
            if any(page.file == file for page in planes.values()):
                tiles.append(_ome_tile(file, image, pixels, planes))
    shared = len(tiles) > 1
    return [replace(tile, name=Path(f"{file}#{k}")) if shared else tile for k, tile in enumerate(tiles)]


def _companion(file: Path) -> str | None:
    """The OME-XML that a file of a set refers to."""
    try:
        with open_regular(file) as stream:
            if stream.read(4) not in TIFF_MAGIC:
                return file.read_text(encoding="utf-8")
            stream.seek(0)
            with _tiff(stream, file) as tiff:
                return str(tiff.ome_metadata or "")
    except (OSError, ValueError, InputError):
        return None


def _ome_tile(
    file: Path, image: ElementTree.Element, pixels: ElementTree.Element, planes: dict[tuple[int, int, int], Page]
) -> StoredTile:
    names = tuple(channel.get("Name", "") for channel in pixels.iter("Channel"))
    elements = [(plane, "Position") for plane in pixels.iter("Plane")]
    elements += [(label, "") for label in image.iter("StageLabel")]
    place = next((t for t in elements if {f"{t[1]}X", f"{t[1]}Y"} <= t[0].attrib.keys()), None)
    position, unit = None, None
    if place is not None:
        element, prefix = place
        position = float(element.attrib[f"{prefix}X"]), float(element.attrib[f"{prefix}Y"])
        # What programs write that do not know the unit counts pixels.
        unit = MICROMETRES.get(element.get(f"{prefix}XUnit", "µm"))
    return StoredTile(file, planes, position, unit, ome_pixel_size(pixels), names if all(names) else ())


def _micro_manager_tag(page: Any) -> dict[str, Any] | None:
    """What Micro-Manager wrote of a page."""
    tag = page.aspage().tags.get("MicroManagerMetadata")
    value = None if tag is None else tag.value
    with suppress(ValueError):
        value = json.loads(value) if isinstance(value, str | bytes) else value
    return value if isinstance(value, dict) else None


def _micro_manager(name: Path, entries: Sequence[tuple[Page, Mapping[str, Any]]]) -> StoredTile:
    """A tile by what Micro-Manager wrote of its planes."""
    planes: dict[tuple[int, int, int], Page] = {}
    channels: dict[int, str] = {}
    for page, entry in entries:
        channel, level, time = (
            int(next((entry[key] for key in keys if isinstance(entry.get(key), int)), 0))
            for keys in (("ChannelIndex",), ("SliceIndex", "Slice"), ("FrameIndex", "Frame"))
        )
        planes.setdefault((channel, level, time), page)
        channels[channel] = str(entry.get("Channel", ""))
    about = entries[0][1]
    position, pixel_size = None, None
    with suppress(TypeError, ValueError, LookupError):
        position = float(about["XPositionUm"]), float(about["YPositionUm"])
        pixel_size = float(about.get("PixelSizeUm") or 0.0) or None
    names = tuple(channels.get(k, "") for k in range(max(channels) + 1))
    return StoredTile(name, planes, position, 1.0, pixel_size, names if all(names) else ())


def _micro_manager_folder(folder: Path) -> dict[str, StoredTile]:
    """Tiles by the names of their files, of a folder with Micro-Manager's metadata; none of others."""
    try:
        content = json.loads(read_text(folder / _FOLDER_METADATA))
    except (InputError, ValueError, RecursionError):
        return {}
    groups: dict[object, list[tuple[Page, Mapping[str, Any]]]] = {}
    for key, entry in content.items() if isinstance(content, dict) else ():
        if isinstance(entry, dict) and "XPositionUm" in entry:
            name = canonical_text(Path(str(entry.get("FileName") or key.removeprefix("Metadata-"))).name)
            place = tuple(entry.get(part) for part in ("PositionIndex", "PositionName", "XPositionUm", "YPositionUm"))
            groups.setdefault(place, []).append((Page(folder / name, 0), entry))
    tiles: dict[str, StoredTile] = {}
    for entries in groups.values():
        first = entries[0][0].file
        tile = _micro_manager(folder if len(groups) == 1 and len(entries) > 1 else first, entries)
        tiles |= {page.file.name: tile for page, _ in entries}
    return tiles
