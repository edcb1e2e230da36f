"""Files that are not what their names promise, each made from a good image."""

import io
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

Make = Callable[[Path, Path], Path]
"""Called with a good image and a folder; gives the path of the bad file."""


def _encoded(good: Path, kind: str, **options: Any) -> bytes:
    stream = io.BytesIO()
    with Image.open(good) as image:
        image.save(stream, kind, **options)
    return stream.getvalue()


def holding(name: str, data: bytes) -> Make:
    """A file with this content."""

    def make(good: Path, folder: Path) -> Path:
        (folder / name).write_bytes(data)
        return folder / name

    return make


def cut(kind: str, share: float, suffix: str) -> Make:
    """An image of which only the first part is there."""

    def make(good: Path, folder: Path) -> Path:
        data = _encoded(good, kind)
        file = folder / f"cut.{suffix}"
        file.write_bytes(data[: max(1, int(share * len(data)))])
        return file

    return make


def drawn(array: NDArray[Any], name: str = "drawn.png") -> Make:
    def make(good: Path, folder: Path) -> Path:
        file = folder / name
        if file.suffix == ".tif":
            tifffile.imwrite(file, array)
        else:
            assert cv2.imwrite(str(file), array)
        return file

    return make


def missing(good: Path, folder: Path) -> Path:
    return folder / "missing.jpg"


def a_folder(good: Path, folder: Path) -> Path:
    (folder / "folder.jpg").mkdir()
    return folder / "folder.jpg"


def a_pipe(good: Path, folder: Path) -> Path:
    """A pipe, from which nobody will ever read anything."""
    os.mkfifo(folder / "pipe.png")
    return folder / "pipe.png"


def a_loop(good: Path, folder: Path) -> Path:
    (folder / "loop.png").symlink_to("loop.png")
    return folder / "loop.png"


def a_dangling_link(good: Path, folder: Path) -> Path:
    (folder / "dangling.png").symlink_to("nowhere.png")
    return folder / "dangling.png"


def too_long_a_name(good: Path, folder: Path) -> Path:
    return folder / ("x" * 300 + ".png")


def damaged_png(good: Path, folder: Path) -> Path:
    """Bits that fell over in the middle."""
    data = bytearray(good.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 64] = bytes(64)
    (folder / "damaged.png").write_bytes(data)
    return folder / "damaged.png"


def _png(width: int, height: int, body: bytes = b"") -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(body)) + chunk(b"IEND", b"")


def damaged_tiff(good: Path, folder: Path) -> Path:
    """A directory of tags that points beyond the end of the file."""
    data = bytearray(_encoded(good, "TIFF"))
    data[4:8] = struct.pack("<I", len(data) + 1000)
    (folder / "damaged.tif").write_bytes(data)
    return folder / "damaged.tif"


_TEXT = b"This is not an image.\n" * 40
_NOISE = np.random.default_rng(1).integers(0, 256, 5000, dtype=np.uint8).tobytes()

UNREADABLE: dict[str, Make] = {
    "missing": missing,
    "folder": a_folder,
    "pipe": a_pipe,
    "symlink loop": a_loop,
    "dangling link": a_dangling_link,
    "too long a name": too_long_a_name,
    "empty": holding("empty.jpg", b""),
    "one byte": holding("one.png", b"\x89"),
    "text as .jpg": holding("text.jpg", _TEXT),
    "text as .tif": holding("text.tif", _TEXT),
    "noise as .png": holding("noise.png", _NOISE),
    "web page as .jpg": holding("page.jpg", b"<!DOCTYPE html><html><body>404</body></html>"),
    "PDF as .jpg": holding("paper.jpg", b"%PDF-1.7\n" + _NOISE),
    "PNG header, then noise": holding("half.png", b"\x89PNG\r\n\x1a\n" + _NOISE),
    "JPEG header, then noise": holding("half.jpg", b"\xff\xd8\xff\xe0\x00\x10JFIF\0" + _NOISE),
    "TIFF header, then noise": holding("half.tif", b"II*\0\x08\0\0\0" + _NOISE),
    "name with spaces": holding("an image of nothing.jpg", _TEXT),
    "name with quotes": holding('it\'s "nothing".jpg', _TEXT),
    "name with a newline": holding("two\nlines.jpg", _TEXT),
    "name that is not UTF-8": holding(os.fsdecode(b"caf\xe9.jpg"), _TEXT),
    "name like an option": holding("--help.jpg", _TEXT),
    "damaged PNG": damaged_png,
    "damaged TIFF": damaged_tiff,
    "PNG without rows": holding("short.png", _png(400, 300)),
    "PNG of 3.6 gigapixels": holding("bomb.png", _png(60000, 60000)),
    "PNG of no size": holding("none.png", _png(0, 300)),
    **{f"PNG cut at {share:.0%}": cut("PNG", share, "png") for share in (0.0003, 0.01, 0.5, 0.98)},
    **{f"JPEG cut at {share:.0%}": cut("JPEG", share, "jpg") for share in (0.001, 0.01, 0.5, 0.9)},
    **{f"TIFF cut at {share:.0%}": cut("TIFF", share, "tif") for share in (0.00001, 0.3, 0.9)},
    **{f"WebP cut at {share:.0%}": cut("WEBP", share, "webp") for share in (0.001, 0.6)},
    "GIF cut": cut("GIF", 0.4, "gif"),
    "BMP cut": cut("BMP", 0.5, "bmp"),
}
"""Status 3, one line that names the file."""

UNUSABLE: dict[str, Make] = {
    "one pixel": drawn(np.full((1, 1, 3), 90, np.uint8)),
    "two pixels": drawn(np.full((1, 2), 90, np.uint8)),
    "30000 x 20 px": drawn(np.random.default_rng(0).integers(0, 256, (20, 30000), dtype=np.uint8)),
    "20 x 30000 px": drawn(np.random.default_rng(0).integers(0, 256, (30000, 20), dtype=np.uint8)),
    "black": drawn(np.zeros((300, 400, 3), np.uint8)),
    "white": drawn(np.full((300, 400), 255, np.uint8)),
    "black, 16 bit": drawn(np.zeros((300, 400, 3), np.uint16)),
    "nothing but noise": drawn(np.random.default_rng(2).integers(0, 256, (300, 400, 3), dtype=np.uint8)),
    "transparent everywhere": drawn(np.zeros((300, 400, 4), np.uint8)),
    "NaN everywhere": drawn(np.full((300, 400), np.nan, np.float32), "nan.tif"),
    "infinite everywhere": drawn(np.full((300, 400), np.inf, np.float32), "inf.tif"),
    "stack of tiny images": drawn(np.zeros((3, 4, 5, 6, 7), dtype=np.uint8), "volume.tif"),
    "chessboard": drawn((np.indices((300, 400)) // 20).sum(0).astype(np.uint8) % 2 * np.uint8(255)),
}
"""Images that fit to nothing: status 4, and no output."""
