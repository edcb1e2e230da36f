"""Blocks of EXIF without what is not true of an output any more."""

import struct
from collections.abc import Callable

from PIL import ExifTags, Image

from rdstitch.io.attitude import finite
from rdstitch.io.exif_tags import ORIENTATION, PIXEL_HEIGHT, PIXEL_WIDTH

_MAKER_NOTE = 0x927C
_UNWRITABLE = (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, struct.error)
_TIMES = {int(getattr(ExifTags.Base, name)) for name in ("DateTimeOriginal", "OffsetTimeOriginal")}
_AUTHOR_TAGS = {
    int(getattr(ExifTags.Base, name))
    for name in ("Make", "Model", "Artist", "Copyright", "DateTime", "Software", "ImageDescription", "Orientation")
}


def upright_exif(exif: Image.Exif, width: int) -> bytes:
    """EXIF for the output: what orientation, size and maker note said is no longer true of it.

    The resolution of the focal plane counts pixels of the size that EXIF says; ``width`` is that of the image.
    """
    if not len(exif):
        return b""

    def clean(kept: Image.Exif) -> None:
        photo = kept.get_ifd(ExifTags.IFD.Exif)
        original = finite(photo.get(PIXEL_WIDTH))
        for tag in (ExifTags.Base.FocalPlaneXResolution, ExifTags.Base.FocalPlaneYResolution):
            if original and (resolution := finite(photo.get(tag))) and original != width:
                photo[tag] = resolution * width / original
        for gone in (PIXEL_WIDTH, PIXEL_HEIGHT, _MAKER_NOTE):
            photo.pop(gone, None)

    # First, since what is not of the type that belongs to it cannot be written.
    exif[ORIENTATION] = 1
    try:
        data = exif.tobytes()
    except _UNWRITABLE:
        return b""
    return _edited(data, clean)


def without_film_size(data: bytes) -> bytes:
    """EXIF of an image that was cut or extended: of what film it would be that of is not true."""
    film = ExifTags.Base.FocalLengthIn35mmFilm
    return _edited(data, lambda exif: exif.get_ifd(ExifTags.IFD.Exif).pop(film, None))


def author_and_time(data: bytes) -> bytes:
    """EXIF of an image made from several: no lens, exposure or place of one of them is true of it."""
    return _edited(data, _keep_author_and_time)


def _edited(data: bytes, edit: Callable[[Image.Exif], object]) -> bytes:
    """An EXIF block after a change; empty where it cannot be written, or says nothing."""
    exif = Image.Exif()
    try:
        exif.load(data)
        edit(exif)
        return exif.tobytes() if len(exif) else b""
    except _UNWRITABLE:
        return b""


def _keep_author_and_time(exif: Image.Exif) -> None:
    photo = exif.get_ifd(ExifTags.IFD.Exif)
    for tag in set(photo) - _TIMES:
        del photo[tag]
    for tag in set(exif) - _AUTHOR_TAGS - {int(ExifTags.IFD.Exif)}:
        del exif[tag]
