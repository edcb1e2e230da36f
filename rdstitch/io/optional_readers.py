"""Images that only optional packages read: HEIC of phones (``pillow-heif``), raw files of cameras (``rawpy``)."""

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageFile, UnidentifiedImageError

from rdstitch.errors import InputError

Factory = Callable[[IO[bytes], str], ImageFile.ImageFile]

HEIF_SUFFIXES = frozenset((".heic", ".heif", ".hif"))
RAW_SUFFIXES = frozenset(
    (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw", ".nrw", ".iiq", ".3fr", ".erf")
)
"""What TIFF readers see in raw files is their thumbnail."""

_EXTRAS = {"pillow_heif": "heif", "rawpy": "raw"}
_BITS = 16
_KEPT_TAGS = {
    *(ExifTags.Base.Make, ExifTags.Base.Model, ExifTags.Base.Artist, ExifTags.Base.Copyright, ExifTags.Base.DateTime)
}
_KEPT_BLOCKS = (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo)


def check_reader(path: Path) -> None:
    """Refuse a file whose reader is not installed."""
    suffix = path.suffix.lower()
    if suffix in HEIF_SUFFIXES:
        _package("pillow_heif", path)
    elif suffix in RAW_SUFFIXES:
        _package("rawpy", path)


def heif_factory(path: Path) -> Factory:
    """What opens HEIC; no opener is registered with Pillow, since that would be for the whole process."""
    factory: Factory = _package("pillow_heif", path).HeifImageFile
    return factory


def avif_factory(path: Path) -> Factory:
    """What opens AVIF: Pillow, since version 11.3."""
    try:
        factory: Factory = import_module("PIL.AvifImagePlugin").AvifImageFile
    except ImportError:
        raise InputError(f"{path}: AVIF needs Pillow 11.3 or newer; or convert it to JPEG or TIFF") from None
    return factory


def is_raw(path: Path) -> bool:
    """Whether a file is a camera's raw file, by its name."""
    return path.suffix.lower() in RAW_SUFFIXES


def read_raw(path: Path) -> NDArray[np.uint16]:
    """Samples (h, w, 3) of a raw file, upright, with the camera's white balance, in sRGB without automatic exposure."""
    with _raw(path) as raw:
        samples = raw.postprocess(use_camera_wb=True, no_auto_bright=True, output_bps=_BITS)
        return np.asarray(samples, dtype=np.uint16)


def raw_size(path: Path) -> tuple[int, int]:
    """Width and height of a raw file, upright, without developing it."""
    with _raw(path) as raw:
        sizes = raw.sizes
        sideways = sizes.flip in (5, 6)
        size = (sizes.iheight, sizes.iwidth) if sideways else (sizes.iwidth, sizes.iheight)
        return int(size[0]), int(size[1])


def raw_exif(path: Path) -> Image.Exif:
    """EXIF of a raw file: most are TIFF, others have a preview with it; what describes how it is stored is left out."""
    exif = Image.Exif()
    with suppress(SyntaxError, ValueError, OSError, struct.error), path.open("rb") as stream:
        exif.load_from_fp(stream)
    if not len(exif):
        exif = _exif_of_preview(path)
    kept = Image.Exif()
    for tag in set(exif) & _KEPT_TAGS:
        kept[tag] = exif[tag]
    for ifd in _KEPT_BLOCKS:
        kept.get_ifd(ifd).update(exif.get_ifd(ifd))
    return kept


def _exif_of_preview(path: Path) -> Image.Exif:
    package = _package("rawpy", path)
    with suppress(package.LibRawError, UnidentifiedImageError), package.imread(str(path)) as raw:
        preview = raw.extract_thumb()
        if preview.format == package.ThumbFormat.JPEG:
            with Image.open(BytesIO(preview.data)) as image:
                return image.getexif()
    return Image.Exif()


@contextmanager
def _raw(path: Path) -> Iterator[Any]:
    """An opened raw file; failures of LibRaw become those of any decoder."""
    package = _package("rawpy", path)
    try:
        with package.imread(str(path)) as raw:
            yield raw
    except package.LibRawError as error:
        text = error.args[0] if error.args else ""
        raise ValueError(text.decode() if isinstance(text, bytes) else str(error)) from error


def _package(name: str, path: Path) -> Any:
    try:
        return import_module(name)
    except ImportError:
        extra = _EXTRAS[name]
        remedy = f'pip install "rdstitch[{extra}]"; or convert it to JPEG or TIFF'
        raise InputError(f"{path}: {path.suffix} needs the extra {extra}: {remedy}") from None
