"""The order of a Cloud Optimized GeoTIFF: what describes the pages first, then the pixels, smallest overview first.

So a reader of a part fetches little but that part. While an image is being made nobody knows where its parts will lie:
compressed tiles are copied afterwards.
"""

import struct
from itertools import accumulate
from pathlib import Path
from typing import BinaryIO, NamedTuple

from rdstitch.results.messages import Message
from rdstitch.system.late_imports import tifffile

_OFFSETS = (324, 273)  # tags: of tiles and strips
_ENTRY = "HH"  # of a directory, before count and value


class _Page(NamedTuple):
    """A directory: type, count and bytes of each value by its code; and where its tiles lie, and how long they are."""

    values: dict[int, tuple[int, int, bytes]]
    offsets: tuple[int, ...]
    lengths: tuple[int, ...]

    def bytes_at(self, room: int) -> int:
        """Bytes, where values of so many fit into their entries."""
        entries = len(self.values) * (struct.calcsize(f"={_ENTRY}") + 2 * room)
        longer = sum(_even(len(data)) for _, _, data in self.values.values() if len(data) > room)
        return _head(room) + entries + room + longer


def put_in_order(path: Path) -> list[Message]:
    """Rewrite a TIFF file: header, directories in their order, tiles of the last page, …, tiles of the first.

    Needs room for a copy beside it; where there is none the file, which is whole, stays, and a message says so.
    """
    ordered = path.with_name(f"{path.name}.ordered")
    try:
        _write_ordered(path, ordered)
        ordered.replace(path)
    except OSError as error:
        ordered.unlink(missing_ok=True)
        reason = error.strerror or error
        return [Message(f"the TIFF file is whole, but not in the order of a Cloud Optimized GeoTIFF: {reason}")]
    return []


def _write_ordered(path: Path, ordered: Path) -> None:
    with tifffile.TiffFile(path) as tiff, path.open("rb") as source, ordered.open("wb") as target:
        order, room = tiff.byteorder, 8 if tiff.is_bigtiff else 4
        pages = [_page(source, page) for page in tiff.pages]
        place = 2 * room
        target.write(_bytes_at(source, 0, room) + _packed(order, room, [place]))
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
    values = {
        int(tag.code): (int(tag.dtype), int(tag.count), _bytes_at(source, tag.valueoffset, tag.valuebytecount))
        for tag in page.tags
    }
    return _Page(values, tuple(page.dataoffsets), tuple(page.databytecounts))


def _directory(page: _Page, order: str, room: int, place: int, following: int, offsets: list[int]) -> bytes:
    """A directory at a place, with where the next one and its own tiles will lie."""
    entries, longer = [], b""
    place += page.bytes_at(room)
    place -= sum(_even(len(data)) for _, _, data in page.values.values() if len(data) > room)
    for code, (kind, count, data) in page.values.items():
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
