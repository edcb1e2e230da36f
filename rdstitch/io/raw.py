"""Raw files of cameras, which rawpy develops."""

import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, UnidentifiedImageError

from rdstitch.io.exif import exif_blocks
from rdstitch.io.opening import reader_package

_BITS = 16
_ORIENTATIONS = {0: 1, 1: 2, 2: 4, 3: 3, 4: 5, 5: 8, 6: 6, 7: 7}  # EXIF's, by what LibRaw calls flip
_KEPT_TAGS = {int(getattr(ExifTags.Base, name)) for name in ("Make", "Model", "Artist", "Copyright", "DateTime")}


def own_exif(exif: Image.Exif) -> Image.Exif:
    """EXIF of a directory of TIFF, without what describes how the file is stored."""
    kept = Image.Exif()
    for tag in set(exif) & _KEPT_TAGS:
        kept[tag] = exif[tag]
    for tag, block in exif_blocks(exif).items():
        kept.get_ifd(tag).update(block)
    return kept


def read_raw(path: Path) -> NDArray[np.uint16]:
    """Samples (h, w, 3) of a raw file as it is stored, with the camera's white balance, in sRGB, not brightened."""
    with _raw(path) as raw:
        samples = raw.postprocess(use_camera_wb=True, no_auto_bright=True, output_bps=_BITS, user_flip=0)
        return np.asarray(samples, dtype=np.uint16)


def raw_size(path: Path) -> tuple[tuple[int, int], int]:
    """Width and height of a raw file as it is stored, and its EXIF orientation, without developing it."""
    with _raw(path) as raw:
        sizes = raw.sizes
        return (int(sizes.iwidth), int(sizes.iheight)), _ORIENTATIONS[sizes.flip]


def raw_exif(path: Path) -> Image.Exif:
    """EXIF of a raw file: most are TIFF, others have a preview with it; what describes how it is stored is left out."""
    exif = Image.Exif()
    with suppress(SyntaxError, ValueError, OSError, struct.error), path.open("rb") as stream:
        exif.load_from_fp(stream)
    if not len(exif):
        exif = _exif_of_preview(path)
    return own_exif(exif)


def _exif_of_preview(path: Path) -> Image.Exif:
    package = reader_package("rawpy", path)
    with suppress(package.LibRawError, UnidentifiedImageError), package.imread(str(path)) as raw:
        preview = raw.extract_thumb()
        if preview.format == package.ThumbFormat.JPEG:
            with Image.open(BytesIO(preview.data)) as image:
                return image.getexif()
    return Image.Exif()


@contextmanager
def _raw(path: Path) -> Iterator[Any]:
    """An opened raw file; failures of LibRaw become those of any decoder."""
    package = reader_package("rawpy", path)
    try:
        with package.imread(str(path)) as raw:
            yield raw
    except package.LibRawError as error:
        text = error.args[0] if error.args else ""
        raise ValueError(text.decode() if isinstance(text, bytes) else str(error)) from error
