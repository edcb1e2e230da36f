"""Opening image files: only the formats below, only regular files, and nothing of them decoded yet.

Optional packages read HEIC of phones (``pillow-heif``) and raw files of cameras (``rawpy``).

Failures of the decoders end as one InputError. Their warnings and log messages go where those of any library go: the
process that this runs in decides what becomes of them, since Python's filters and handlers belong to all its threads.
"""

import os
import re
import stat
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, BinaryIO

import cv2
from PIL import Image, ImageFile

from rdstitch.errors import InputError
from rdstitch.system.file_access import is_url, open_regular, remote_status
from rdstitch.system.late_imports import tifffile
from rdstitch.system.machine import memory_size

HEIF_SUFFIXES = frozenset((".heic", ".heif", ".hif"))
RAW_SUFFIXES = frozenset(
    (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw", ".nrw", ".iiq", ".3fr", ".erf")
)
"""What TIFF readers see in raw files is their thumbnail."""

_PACKAGES = ((HEIF_SUFFIXES, "pillow_heif"), (RAW_SUFFIXES, "rawpy"))  # what reads them, where it is installed

# What Pillow, tifffile and OpenCV have been seen to raise on damaged files; warnings, where filters make them errors.
_DAMAGE = (
    Warning,
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    LookupError,
    ArithmeticError,
    AttributeError,
    RuntimeError,
    AssertionError,
    EOFError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
    cv2.error,
)

TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"

# What reads which format, by its first bytes: Pillow opens some forty, and starts Ghostscript for one, whatever a
# file is called. Readers are imported when they are needed.
_FORMATS = {
    b"\xff\xd8\xff": "PIL.JpegImagePlugin:jpeg_factory",
    PNG_MAGIC: "PIL.PngImagePlugin:PngImageFile",
    b"RIFF": "PIL.WebPImagePlugin:WebPImageFile",
    b"BM": "PIL.BmpImagePlugin:BmpImageFile",
    b"GIF8": "PIL.GifImagePlugin:GifImageFile",
    **dict.fromkeys((b"\xff\x4f\xff\x51", b"\0\0\0\x0cjP  \r\n\x87\n"), "PIL.Jpeg2KImagePlugin:Jpeg2KImageFile"),
    **dict.fromkeys((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6"), "PIL.PpmImagePlugin:PpmImageFile"),
}

# Pillow's words for how the pixels of 16 bits are stored, and the byte of other formats that tells of their bits.
_DEEP_PIECES = {"PNG": "16", "PPM": "65535"}
_DEPTH_IN_HEADER = {
    "AVIF": re.compile(rb"av1C..(.)", re.DOTALL),
    "JPEG2000": re.compile(rb"\xff\x4f\xff\x51.{38}(.)", re.DOTALL),
}
_MAX_HEADER = 2**21
DEEP_MODES = ("RGB", "RGBA", "LA")
"""Pillow's modes of samples that are 8-bit there, and may have been deeper."""

_BIT_DEPTHS = {"1": 1, "I;16": 16, "I;16B": 16, "I;16L": 16, "I": 32, "F": 32}
_MAX_MAGIC = max(map(len, _FORMATS))
_NAMES = "JPEG, PNG, TIFF, WebP, AVIF, HEIC, BMP, TGA, GIF, JPEG 2000, PBM, PGM, PPM"
MAX_IMAGE_GB = "RDSTITCH_MAX_IMAGE_GB"
"""The environment's name of what one decoded image may take at the most, 1e9 bytes."""
_MIN_LIMIT = 178e6 * 3  # bytes of a decoded image, where the environment does not say
_MEMORY_FRACTION = 1 / 8  # of the machine's memory, which is the limit where it is more
_PNG_METADATA = (b"eXIf", b"tEXt", b"zTXt", b"iTXt")


def check_readable(path: Path) -> None:
    """Refuse what cannot be an image file, before a decoder blocks or stumbles on it."""
    remote, regular = is_url(path), True
    if remote and is_raw(path):
        raise InputError(f"{path}: raw files are read from this machine's disks only; download it first")
    try:
        if remote:
            is_folder, size, _ = remote_status(path)
        else:
            status = path.stat()
            is_folder, regular, size = stat.S_ISDIR(status.st_mode), stat.S_ISREG(status.st_mode), status.st_size
    except FileNotFoundError:
        raise InputError(f"{path}: {'no such file; check the address' if remote else _missing(path)}") from None
    except (OSError, ValueError) as error:
        reason = str(error) if remote else f"{getattr(error, 'strerror', None) or error}; check the name"
        raise InputError(f"{path}: {reason}") from error
    if is_folder:
        raise InputError(f"{path}: is a folder, not an image; name the images in it")
    if not regular:
        raise InputError(f"{path}: is not a regular file; copy it to one first")
    if size == 0:
        raise InputError(f"{path}: is empty (0 bytes); copy it again from its source")
    for suffixes, package in _PACKAGES:
        if path.suffix.lower() in suffixes:
            reader_package(package, path)
    if not remote and not os.access(path, os.R_OK):
        raise InputError(f"{path}: permission denied; make it readable")


def _missing(path: Path) -> str:
    """Say what is wrong with a name that leads nowhere, and which one may be meant."""
    if path.is_symlink():
        return "a link to nothing; check the name"
    try:
        names = [entry.name for entry in path.parent.iterdir()]
    except OSError:
        return f"no such file, since there is no folder {path.parent}; check the name"
    what = "file" if path.suffix else "folder"
    alike = [name for name in names if name.lower() == path.name.lower()]
    from difflib import get_close_matches

    alike = alike or get_close_matches(path.name, names, n=1, cutoff=0.8)
    return f"no such {what}; " + (f"did you mean {path.with_name(alike[0])}?" if alike else "check the name")


@contextmanager
def decoding(path: Path) -> Iterator[None]:
    """Run a decoder: its failures become an InputError that names the file."""
    try:
        yield
    except MemoryError as error:
        raise InputError(f"{path}: too large to read into memory; make it smaller first") from error
    except PermissionError as error:
        raise InputError(f"{path}: permission denied; make it readable") from error
    except (*_DAMAGE, tifffile.TiffFileError) as error:
        if isinstance(error, cv2.error) and error.code == cv2.Error.StsNoMem:
            raise InputError(f"{path}: too large to read into memory; make it smaller first") from error
        reason = " ".join(str(error).split()) or type(error).__name__
        reason = reason.replace(f"'{path}'", "the file")
        raise InputError(f"{path}: not an image that can be read, or damaged ({reason[:160]})") from error


@contextmanager
def opened_image(file: Path) -> Iterator[ImageFile.ImageFile]:
    """An image whose header has been read."""
    with open_regular(file) as stream, _factory(file, stream)(stream, str(file)) as image:
        bands = image.getbands()
        check_decoded_size(file, image.size, 4 if "P" in bands else len(bands), stored_bits(image))
        yield image


def stored_bits(image: Image.Image) -> int:
    """Bits per sample as stored; Pillow shows deep colours as 8-bit."""
    pieces = getattr(image, "tile", None)
    if pieces and _DEEP_PIECES.get(image.format or "", "none") in str(pieces[0][3]):
        return 16
    if image.format == "HEIF":
        return int(image.info["bit_depth"])
    stream, pattern = getattr(image, "fp", None), _DEPTH_IN_HEADER.get(image.format or "")
    if stream is None or pattern is None or image.mode not in DEEP_MODES:
        return _BIT_DEPTHS.get(image.mode, 8)
    place = stream.tell()
    stream.seek(0)
    found = pattern.search(stream.read(_MAX_HEADER))
    stream.seek(place)
    kind = 0 if found is None else found[1][0]
    bits = 8 + 2 * (kind >> 6 & 1) + 2 * (kind >> 5 & 1) if image.format == "AVIF" else 1 + (kind & 0x7F)
    return bits if 8 < bits <= 16 else 8


def has_late_metadata(file: Path) -> bool:
    """Check whether a PNG file says something of itself after its pixels, or cannot be followed to its end.

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


def check_decoded_size(file: Path, size: tuple[int, int], channels: int, bits: int) -> None:
    """Refuse by its header what would fill the machine's memory, as only a damaged or malicious file does."""
    need = size[0] * size[1] * channels * -(-bits // 8) / 1e9
    setting = os.environ.get(MAX_IMAGE_GB, "")
    try:
        limit = float(setting) if setting else max(_MIN_LIMIT, _MEMORY_FRACTION * memory_size()) / 1e9
    except ValueError:
        raise InputError(f"{MAX_IMAGE_GB}={setting}: expected a number of gigabytes") from None
    if not need <= limit:
        raise InputError(
            f"{file}: {size[0]} x {size[1]} pixels take {need:.1f} GB of memory, more than {limit:.1f}; cut "
            f"it up or make it smaller first, or set {MAX_IMAGE_GB} to more than an eighth of the machine's memory"
        )


def _factory(file: Path, stream: BinaryIO) -> Any:
    """What opens the format of a file, by its first bytes: makes an image of a stream and its name."""
    beginning = stream.read(_MAX_MAGIC)
    stream.seek(0)
    for magic, reader in _FORMATS.items():
        if beginning.startswith(magic):
            return resolve_name(reader)
    if beginning[4:8] == b"ftyp":
        if beginning[8:12] in (b"avif", b"avis"):
            return resolve_name("PIL.AvifImagePlugin:AvifImageFile")
        # No opener is registered with Pillow, since that would be for the whole process.
        return reader_package("pillow_heif", file).HeifImageFile
    if file.suffix.lower() == ".tga":  # has no magic
        return resolve_name("PIL.TgaImagePlugin:TgaImageFile")
    raise InputError(f"{file}: not an image in a supported format: {_NAMES}")


def is_raw(path: Path) -> bool:
    """Check whether a file is a camera's raw file, by its name."""
    return path.suffix.lower() in RAW_SUFFIXES


def reader_package(name: str, path: Path) -> Any:
    """The optional package that reads a file."""
    try:
        return import_module(name)
    except ImportError:
        package = name.replace("_", "-")
        remedy = f"pip install {package}; or convert it to JPEG or TIFF"
        raise InputError(f"{path}: {path.suffix} needs {package}: {remedy}") from None
