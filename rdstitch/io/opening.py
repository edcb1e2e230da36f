"""Opening picture files: only the formats below, only regular files, and nothing of them decoded yet."""

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, BinaryIO

from PIL import (
    BmpImagePlugin,
    GifImagePlugin,
    ImageFile,
    Jpeg2KImagePlugin,
    JpegImagePlugin,
    PngImagePlugin,
    PpmImagePlugin,
    TgaImagePlugin,
    TiffImagePlugin,
    WebPImagePlugin,
)

from rdstitch.errors import InputError
from rdstitch.file_access import open_regular
from rdstitch.io.optional_readers import avif_factory, heif_factory

TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"

# Pillow opens some forty formats, and starts Ghostscript for one of them, whatever a file is called.
_FORMATS: dict[bytes, Callable[[IO[bytes], str], ImageFile.ImageFile]] = {
    b"\xff\xd8\xff": JpegImagePlugin.jpeg_factory,
    PNG_MAGIC: PngImagePlugin.PngImageFile,
    **dict.fromkeys(TIFF_MAGIC, TiffImagePlugin.TiffImageFile),
    b"RIFF": WebPImagePlugin.WebPImageFile,
    b"BM": BmpImagePlugin.BmpImageFile,
    b"GIF8": GifImagePlugin.GifImageFile,
    b"\xff\x4f\xff\x51": Jpeg2KImagePlugin.Jpeg2KImageFile,
    b"\0\0\0\x0cjP  \r\n\x87\n": Jpeg2KImagePlugin.Jpeg2KImageFile,
    **dict.fromkeys((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6"), PpmImagePlugin.PpmImageFile),
}
_MAX_MAGIC = max(map(len, _FORMATS))
_NAMES = "JPEG, PNG, TIFF, WebP, AVIF, HEIC, BMP, TGA, GIF, JPEG 2000, PBM, PGM, PPM"
_MAX_MEGAPIXELS = 178
_PNG_METADATA = (b"eXIf", b"tEXt", b"zTXt", b"iTXt")


@contextmanager
def opened_picture(file: Path) -> Iterator[ImageFile.ImageFile]:
    """A picture whose header has been read.

    Raises
    ------
    InputError
        When it is none of these formats, or larger than any camera's.
    OSError, SyntaxError, …
        What :func:`rdstitch.io.decoding.decoding` makes an InputError of: the file is missing, no regular one, or
        damaged.
    """
    with open_regular(file) as stream, _factory(file, stream)(stream, str(file)) as image:
        check_megapixels(file, image.size)
        yield image


def has_late_metadata(file: Path) -> bool:
    """Whether a PNG file says something of itself after its pixels, or cannot be followed to its end.

    Only the heads of its chunks are read. Pillow looks for EXIF there, and decodes all pixels to come there.
    """
    with open_regular(file) as stream:
        stream.seek(len(PNG_MAGIC))
        pixels = False
        while len(head := stream.read(8)) == 8:
            length, kind = struct.unpack(">I4s", head)
            if kind == b"IEND":
                return False
            pixels |= kind == b"IDAT"
            if pixels and kind in _PNG_METADATA:
                return True
            stream.seek(length + 4, 1)
    return True


def check_megapixels(file: Path, size: tuple[int, int]) -> None:
    """Refuse what claims to be larger than any camera's picture.

    Raises
    ------
    InputError
        The text says what to do.
    """
    megapixels = size[0] * size[1] / 1e6
    if megapixels > _MAX_MEGAPIXELS:
        raise InputError(
            f"{file}: {size[0]} x {size[1]} pixels are {megapixels:.0f} megapixels, more than {_MAX_MEGAPIXELS}; "
            "cut it up or make it smaller first"
        )


def _factory(file: Path, stream: BinaryIO) -> Callable[[IO[bytes], str], ImageFile.ImageFile]:
    """What opens the format of a file, by its first bytes."""
    beginning = stream.read(_MAX_MAGIC)
    stream.seek(0)
    for magic, factory in _FORMATS.items():
        if beginning.startswith(magic):
            return factory
    if beginning[4:8] == b"ftyp":
        return avif_factory(file) if beginning[8:12] in (b"avif", b"avis") else heif_factory(file)
    if file.suffix.lower() == ".tga":  # has no magic
        return TgaImagePlugin.TgaImageFile
    raise InputError(f"{file}: is no picture in a format that is read here: {_NAMES}")
