"""What EXIF says of a camera and of when and where it was, and EXIF blocks without tags that no longer hold.

Implausible values count as missing.
"""

import math
import struct
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import datetime
from typing import TYPE_CHECKING, Any

from PIL import ExifTags, Image

from rdstitch.geometry.camera import is_focal_length
from rdstitch.geometry.places import GpsPosition
from rdstitch.io.attitude import finite, xmp_number

if TYPE_CHECKING:
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_MM_PER_RESOLUTION_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_EXPOSURE_TAGS = (ExifTags.Base.ExposureTime, ExifTags.Base.FNumber, ExifTags.Base.ISOSpeedRatings)
# A calibrated principal point within so much (log) of the middle of the stored width belongs to that width.
_MAX_OFF_MIDDLE = 0.05
# How many times as long one tag's focal length may be as another's: crops for video, and what "35 mm equivalent" means.
_MAX_CONTRADICTION = 1.25
_UNWRITABLE = (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, struct.error)
_TIMES = {int(getattr(ExifTags.Base, name)) for name in ("DateTimeOriginal", "OffsetTimeOriginal")}
_AUTHOR_TAGS = {
    int(getattr(ExifTags.Base, name))
    for name in ("Make", "Model", "Artist", "Copyright", "DateTime", "Software", "ImageDescription", "Orientation")
}


def tag_text(value: Any) -> str:
    """Printable text of a tag that may be bytes, padded with zeros, or absent."""
    text = value.decode("latin-1") if isinstance(value, bytes) else str(value or "")
    return text.split("\0")[0].strip()


def orientation_of(value: Any) -> int:
    """EXIF orientation, also where a program has stored it as text or as a float; 1 where it means nothing."""
    if isinstance(value, tuple) and value:
        value = value[0]
    number = finite(tag_text(value) if isinstance(value, bytes) else value)
    return 1 if number is None or number not in range(1, 9) else int(number)


def exposure_of(photo: Mapping[int, Any]) -> float | None:
    """Exposure time x sensitivity / f-number²; without a number or a sensitivity, these are taken to be constant."""
    time, aperture, speed = (photo.get(tag) for tag in _EXPOSURE_TAGS)
    speed = speed[0] if isinstance(speed, tuple) and speed else speed
    seconds, number, sensitivity = finite(time), finite(aperture or 1.0), finite(speed or 100.0)
    if not (seconds and number and sensitivity and min(seconds, number, sensitivity) > 0.0):
        return None
    return seconds * sensitivity / number**2


def focal_length(photo: Mapping[int, Any], xmp: str, size: tuple[int, int]) -> float | None:
    """Focal length in pixels, by the most direct tag that has one; None where tags contradict one another."""
    calibrated, middle = (xmp_number(xmp, name) for name in ("CalibratedFocalLength", "CalibratedOpticalCenterX"))
    focal = finite(photo.get(ExifTags.Base.FocalLength))
    resolution = finite(photo.get(ExifTags.Base.FocalPlaneXResolution))
    unit = _MM_PER_RESOLUTION_UNIT.get(photo.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    equivalent = finite(photo.get(ExifTags.Base.FocalLengthIn35mmFilm))
    # Pixels of the original, which a resized image keeps the tags of.
    width = finite(photo.get(ExifTags.Base.ExifImageWidth)) or size[0]
    calibrated_width = width if not middle or abs(math.log(2.0 * middle / width)) < _MAX_OFF_MIDDLE else 2.0 * middle
    lengths = [
        calibrated * size[0] / calibrated_width if calibrated else None,
        focal * resolution / unit * size[0] / width if focal and resolution and unit else None,
        equivalent / _DIAGONAL_35MM * math.hypot(*size) if equivalent else None,
    ]
    known = [value for value in lengths if value and value > 0.0 and is_focal_length(value, size)]
    return known[0] if known and max(known) <= _MAX_CONTRADICTION * min(known) else None


def time_taken(photo: Mapping[int, Any]) -> float | None:
    """Seconds since 1970 by the EXIF tags of when the image was taken."""
    tags = ExifTags.Base.DateTimeOriginal, ExifTags.Base.OffsetTimeOriginal, ExifTags.Base.SubsecTimeOriginal
    text, zone, fraction = (tag_text(photo.get(tag)) for tag in tags)
    for zoned in (f"{text}{zone or '+00:00'}", f"{text}+00:00"):
        with suppress(ValueError, OverflowError):
            whole = datetime.strptime(zoned, "%Y:%m:%d %H:%M:%S%z").timestamp()
            return whole + (float(f"0.{fraction}") if fraction.isdecimal() else 0.0)
    return None


def gps_position(tags: dict[int, Any], xmp: str) -> tuple[GpsPosition | None, str]:
    """Position from the GPS block with accuracies of XMP, or None where it is absent or impossible, and why."""
    sides = [tag_text(tags.get(tag)).upper()[:1] for tag in (ExifTags.GPS.GPSLatitudeRef, ExifTags.GPS.GPSLongitudeRef)]
    latitude = _degrees(tags.get(ExifTags.GPS.GPSLatitude), sides[0] == "S")
    longitude = _degrees(tags.get(ExifTags.GPS.GPSLongitude), sides[1] == "W")
    if latitude is None or longitude is None or abs(latitude) > 90 or abs(longitude) > 180:
        return None, ""
    if latitude == longitude == 0.0:  # what receivers write that have no fix
        return None, ""
    if sides[0] not in ("N", "S") or sides[1] not in ("E", "W"):
        return None, "its GPS position does not say whether north or south, east or west"
    altitude = finite(tags.get(ExifTags.GPS.GPSAltitude))
    below_sea = tags.get(ExifTags.GPS.GPSAltitudeRef) in (1, 3, b"\x01", b"\x03")  # 3: since EXIF 3.0
    accuracies = (("RtkStdLat", "RtkStdLon", "RtkStdHgt"), ("GPSXYAccuracy", "GPSXYAccuracy", "GPSZAccuracy"))
    deviations = [[xmp_number(xmp, name) or 0.0 for name in names] for names in accuracies]
    along, across, up = next((each for each in deviations if min(each) > 0.0), (0.0, 0.0, 0.0))
    std = (math.hypot(along, across) / math.sqrt(2.0), up) if up else None
    return GpsPosition(latitude, longitude, -altitude if altitude and below_sea else altitude, std), ""


def _degrees(value: Any, negative: bool) -> float | None:
    """Degrees, minutes, seconds to signed degrees."""
    if not isinstance(value, tuple) or not 1 <= len(value) <= 3:
        return None
    parts = [finite(part) for part in value]
    if any(part is None for part in parts):
        return None
    degrees = sum((part or 0.0) / 60.0**k for k, part in enumerate(parts))
    return -degrees if negative else degrees


def upright_exif(exif: Image.Exif, width: int) -> bytes:
    """EXIF for the output: what orientation, size and maker note said is no longer true of it.

    The resolution of the focal plane counts pixels of the size that EXIF says; ``width`` is that of the image.
    """
    if not (len(exif) or any(map(exif.get_ifd, (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo)))):
        return b""

    def clean(kept: Image.Exif) -> None:
        photo = kept.get_ifd(ExifTags.IFD.Exif)
        original = finite(photo.get(ExifTags.Base.ExifImageWidth))
        for tag in (ExifTags.Base.FocalPlaneXResolution, ExifTags.Base.FocalPlaneYResolution):
            if original and (resolution := finite(photo.get(tag))) and original != width:
                photo[tag] = resolution * width / original
        for gone in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight, ExifTags.Base.MakerNote):
            photo.pop(gone, None)

    # First, since what is not of the type that belongs to it cannot be written.
    exif[ExifTags.Base.Orientation] = 1
    try:
        data = _written(exif)
    except _UNWRITABLE:
        return b""
    return _edited(data, clean)


def without_film_size(data: bytes) -> bytes:
    """EXIF of an image that was cut or extended, without a focal length for 35 mm film, which is no longer true."""
    film = ExifTags.Base.FocalLengthIn35mmFilm
    return _edited(data, lambda exif: exif.get_ifd(ExifTags.IFD.Exif).pop(film, None))


def author_and_time(data: bytes) -> bytes:
    """EXIF of an image made from several: no lens, exposure or place of one of them is true of it."""
    return _edited(data, _keep_author_and_time)


def exif_blocks(exif: Image.Exif) -> dict[int, dict[int, Any]]:
    """The blocks of exposure and place, by their tags, with what is a block of its own in that of exposure."""
    photo = exif.get_ifd(ExifTags.IFD.Exif)
    if ExifTags.IFD.Interop in photo:
        photo = {**photo, ExifTags.IFD.Interop: exif.get_ifd(ExifTags.IFD.Interop)}
    return {ExifTags.IFD.Exif: photo, ExifTags.IFD.GPSInfo: exif.get_ifd(ExifTags.IFD.GPSInfo)}


def exif_directories(data: bytes, head: bytes) -> "dict[int, ImageFileDirectory_v2]":
    """Exposure and place of an EXIF block, by their tags, as directories of a TIFF file with such a head."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    exif, made = Image.Exif(), {}
    exif.load(data)
    for block, tags in exif_blocks(exif).items():
        if tags:
            made[block] = ImageFileDirectory_v2(head, group=block)
            made[block].update(tags)
    return made


def _edited(data: bytes, edit: Callable[[Image.Exif], object]) -> bytes:
    """An EXIF block after a change; empty where it cannot be written, or says nothing."""
    exif = Image.Exif()
    try:
        exif.load(data)
        edit(exif)
        return _written(exif) if len(exif) else b""
    except _UNWRITABLE:
        return b""


def _written(exif: Image.Exif) -> bytes:
    """An EXIF block; names keep their bytes, of which Pillow, which reads them as Latin-1, would write ASCII only."""
    names = {tag: text for tag, text in exif.items() if isinstance(text, str) and not text.isascii()}
    exif.update({tag: text.encode("latin-1") for tag, text in names.items()})
    return exif.tobytes()


def _keep_author_and_time(exif: Image.Exif) -> None:
    photo = exif.get_ifd(ExifTags.IFD.Exif)
    for tag in set(photo) - _TIMES:
        del photo[tag]
    for tag in set(exif) - _AUTHOR_TAGS - {int(ExifTags.IFD.Exif)}:
        del exif[tag]
