"""The order of a Cloud Optimized GeoTIFF: what describes the pages first, then the pixels, smallest overview first.

So a reader of a part fetches little but that part. While an image is being made nobody knows where its parts will lie:
compressed tiles are copied afterwards. What EXIF says of exposure and place, for which tifffile makes no directories,
comes with the first page.
"""

import struct
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

from rdstitch.io.exif import exif_directories
from rdstitch.results.messages import Message
from rdstitch.system.late_imports import tifffile

if TYPE_CHECKING:
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

_OFFSETS = (324, 273)  # tags: of tiles and strips
_ENTRY = "HH"  # of a directory, before count and value
_LONG = {4: 4, 8: 16}  # type of a place in the file of so many bytes


class _Page(NamedTuple):
    """A directory: type, count and bytes of each value by its code; and where its tiles lie, and how long they are."""

    values: "dict[int, tuple[int, int, bytes | ImageFileDirectory_v2]]"
    offsets: tuple[int, ...]
    lengths: tuple[int, ...]

    def bytes_at(self, room: int) -> int:
        """Bytes, where values of so many fit into their entries."""
        entries = len(self.values) * (struct.calcsize(f"={_ENTRY}") + 2 * room)
        return _head(room) + entries + room + self.longer(room)

    def longer(self, room: int) -> int:
        """Bytes of values that do not fit."""
        lengths = [len(_bytes_of(value, 0)) for _, _, value in self.values.values()]
        return sum(_even(length) for length in lengths if length > room)


def put_in_order(path: Path, exif: bytes) -> list[Message]:
    """Rewrite a TIFF file: header, directories in their order, tiles of the last page, …, tiles of the first.

    Needs room for a copy beside it; where there is none the file, which is whole, stays, and a message says so.
    """
    ordered = path.with_name(f"{path.name}.ordered")
    try:
        _write_ordered(path, ordered, exif)
        ordered.replace(path)
    except OSError as error:
        ordered.unlink(missing_ok=True)
        reason = error.strerror or error
        lost = "in the order of a Cloud Optimized GeoTIFF, and without EXIF's exposure and place"
        return [Message(f"the TIFF file has all pixels, but not {lost}: {reason}")]
    return []


def _write_ordered(path: Path, ordered: Path, exif: bytes) -> None:
    with tifffile.TiffFile(path) as tiff, path.open("rb") as source, ordered.open("wb") as target:
        order, room = tiff.byteorder, 8 if tiff.is_bigtiff else 4
        pages = [_page(source, page) for page in tiff.pages]
        place = 2 * room
        head = _bytes_at(source, 0, room) + _packed(order, room, [place])
        target.write(head)
        pages[0].values.update((tag, (_LONG[room], 1, made)) for tag, made in exif_directories(exif, head).items())
        *places, place = accumulate((page.bytes_at(room) for page in pages), initial=place)
        tiles = []
        for page in reversed(pages):
            *starts, place = accumulate(map(_even, page.lengths), initial=place)
            tiles.append(starts)
        for page, at, following, offsets in zip(pages, places, [*places[1:], 0], reversed(tiles), strict=True):
            target.write(_directory(page, order, room, at, following, offsets))
        for page in reversed(pages):
            for offset, length in zip(page.offsets, page.lengths, strict=True):
                target.write(_bytes_at(source, offset, length).ljust(_even(length), b"\0"))


def _page(source: BinaryIO, page: "tifffile.TiffPage | tifffile.TiffFrame") -> _Page:
    assert isinstance(page, tifffile.TiffPage)
    values: dict[int, tuple[int, int, bytes | ImageFileDirectory_v2]] = {
        int(tag.code): (int(tag.dtype), int(tag.count), _bytes_at(source, tag.valueoffset, tag.valuebytecount))
        for tag in page.tags
    }
    return _Page(values, tuple(page.dataoffsets), tuple(page.databytecounts))


def _directory(page: _Page, order: str, room: int, place: int, following: int, offsets: list[int]) -> bytes:
    """A directory at a place, with where the next one and its own tiles will lie."""
    entries, longer = [], b""
    place += page.bytes_at(room) - page.longer(room)
    for code, (kind, count, value) in sorted(page.values.items()):
        data = _bytes_of(value, place + len(longer))
        if code in _OFFSETS:
            data = _packed(order, len(data) // count, offsets)
        if len(data) > room:
            shown = _packed(order, room, [place + len(longer)])
            longer += data.ljust(_even(len(data)), b"\0")
        else:
            shown = data.ljust(room, b"\0")
        entries.append(struct.pack(f"{order}{_ENTRY}", code, kind) + _packed(order, room, [count]) + shown)
    head = _packed(order, _head(room), [len(entries)])
    return head + b"".join(entries) + _packed(order, room, [following]) + longer


def _bytes_of(value: "bytes | ImageFileDirectory_v2", place: int) -> bytes:
    """A value as it is at a place, which a directory tells of."""
    return value if isinstance(value, bytes) else value.tobytes(place)


def _head(room: int) -> int:
    return 8 if room == 8 else 2


def _packed(order: str, size: int, numbers: list[int]) -> bytes:
    """Whole numbers of so many bytes each."""
    return struct.pack(f"{order}{len(numbers)}{ {2: 'H', 4: 'I', 8: 'Q'}[size] }", *numbers)


def _bytes_at(source: BinaryIO, offset: int, length: int) -> bytes:
    source.seek(offset)
    return source.read(length)


def _even(length: int) -> int:
    return length + length % 2
