"""What an image file says about itself: size, lens, place, attitude, camera; read without decoding pixels."""

import math
import struct
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
from PIL import ExifTags, Image

from rdstitch.geometry.camera import is_focal_length
from rdstitch.geometry.exif_orientation import turned_size, turning_matrix
from rdstitch.geometry.places import GpsPosition
from rdstitch.io.attitude import Attitude, finite, read_attitude, xmp_number, xmp_text
from rdstitch.io.colour import ink_transform
from rdstitch.io.ome import read_ome
from rdstitch.io.opening import (
    TIFF_MAGIC,
    check_decoded_size,
    check_readable,
    decoding,
    has_late_metadata,
    is_raw,
    opened_image,
)
from rdstitch.io.radiometric_tags import Radiometry, read_radiometry
from rdstitch.io.raw import own_exif, raw_exif, raw_size
from rdstitch.io.read_tiff import channel_count
from rdstitch.system.file_access import open_regular
from rdstitch.system.late_imports import tifffile

_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_MM_PER_RESOLUTION_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_BIT_DEPTHS = {"1": 1, "I;16": 16, "I;16B": 16, "I;16L": 16, "I": 32, "F": 32}
_BLACK_LEVEL = 50714
_EXPOSURE_TAGS = (ExifTags.Base.ExposureTime, ExifTags.Base.FNumber, ExifTags.Base.ISOSpeedRatings)

MAX_PROFILE = 2**20 - 2**10
"""Bytes of a colour profile: PNG readers, such as Pillow's, refuse images whose profile takes a megabyte."""

_EXIF_OF_PNG = {"exif", "Raw profile type exif"}
_COLOUR_SPACE = slice(16, 20)  # of a profile's header
_UNWRITABLE = (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, struct.error)
_HEADER = 16
_TIMES = {int(getattr(ExifTags.Base, name)) for name in ("DateTimeOriginal", "OffsetTimeOriginal")}
_AUTHOR_TAGS = {
    int(getattr(ExifTags.Base, name))
    for name in ("Make", "Model", "Artist", "Copyright", "DateTime", "Software", "ImageDescription", "Orientation")
}
_XMP, _PROFILE, _RESOLUTION, _RESOLUTION_UNIT = 700, 34675, (282, 283), 296
_INCHES = {2: 1.0, 3: 2.54}  # what pixels per unit are multiplied by
# How far, as a logarithm, twice the distance of a calibrated middle from the border may be from the width; and how many
# times as long one tag's focal length may be as another's: crops for video, and what "35 mm equivalent" is taken for.
_BESIDE, _CONTRADICTION = 0.05, 1.25
_ORIENTATION, _PIXEL_WIDTH, _PIXEL_HEIGHT, _MAKER_NOTE = 0x0112, 0xA002, 0xA003, 0x927C


@dataclass(frozen=True)
class Metadata:
    """Everything known of an image file beside its pixels."""

    size: tuple[int, int]  # width and height, pixels, after the EXIF orientation is applied
    bit_depth: int = 8  # bits per sample
    # EXIF orientation (1 to 8) stored in the file; readers of this project have applied it already
    orientation: int = 1
    focal_px: float | None = None  # focal length, pixels, where the file tells it
    gps: GpsPosition | None = None
    gps_problem: str = ""  # why the position in the file is not used; empty where it is, or where there is none
    attitude: Attitude | None = None
    make: str = ""  # make, model, serial: of the camera; empty where not known
    model: str = ""
    serial: str = ""
    dpi: tuple[float, float] | None = None
    # exposure time x sensitivity / f-number²: what the samples' light is proportional to, for the same scene
    exposure: float | None = None
    radiometry: Radiometry | None = None  # of a band of a multispectral camera
    # when it was taken, s since 1970; where EXIF has no time zone, its local time is taken for UTC
    timestamp: float | None = None
    exif: bytes = b""  # EXIF block with orientation 1, without maker note and thumbnail; empty where there is none
    icc_profile: bytes = b""  # colour profile; empty where there is none
    xmp: bytes = b""  # XMP packet that is to be written; what files have is not kept
    profile_lost: str = ""  # why the file's colour profile is not kept; empty where it is, or where there is none
    channels: int = 3  # samples per pixel, with alpha
    pixel_size: float | None = None  # micrometres, where OME-XML says it
    channel_names: tuple[str, ...] = ()  # where OME-XML or Micro-Manager say them
    planes: bool = False  # whether the channels are those of a microscope, on pages of their own, and no colours

    @property
    def nadir(self) -> tuple[float, float, float] | None:
        """Unit vector straight down from the camera: to the right, to the bottom of the image as read, and ahead."""
        if self.attitude is None:
            return None
        *direction, z = self.attitude.nadir
        x, y = (turning_matrix(self.orientation) @ direction).tolist()
        return x, y, z

    def in_another_size(self) -> Self:
        """Of the same image at the same scale but cut or extended: of what film it would be that of is not true."""
        film = ExifTags.Base.FocalLengthIn35mmFilm
        return replace(self, exif=_edited(self.exif, lambda exif: exif.get_ifd(ExifTags.IFD.Exif).pop(film, None)))

    def of_composite(self) -> Self:
        """Of an image made from several: no lens, exposure or place of one of them is true of it."""
        return replace(self, exif=_edited(self.exif, _keep_author_and_time))


def read_metadata(path: str | Path) -> Metadata:
    """Read an image file's header; no pixel is decoded."""
    file = Path(path)
    check_readable(file)
    with decoding(file):
        if is_raw(file):
            return _raw_metadata(file)
        with open_regular(file) as stream:
            if stream.read(len(TIFF_MAGIC[0])) in TIFF_MAGIC:
                stream.seek(0)
                return _tiff_metadata(file, stream)
        with opened_image(file) as image:
            if image.format == "PNG" and not _EXIF_OF_PNG & image.info.keys() and not has_late_metadata(file):
                image.info["exif"] = b""  # so that Pillow does not decode the pixels in search of it
            return metadata_of(image)


def _tiff_metadata(file: Path, stream: BinaryIO) -> Metadata:
    """Metadata of the first page of a TIFF file, whatever its samples are, and of OME-XML."""
    with tifffile.TiffFile(stream, name=str(file)) as tiff:
        page, told = tiff.pages.first, read_ome(tiff.ome_metadata)
        size, channels = (page.imagewidth, page.imagelength), channel_count(page)
        if min(size) < 1:
            raise ValueError("no pixels")
        planes = told is not None and 1 < told.channels <= len(tiff.pages)
        channels = told.channels if told is not None and planes else channels
        check_decoded_size(file, size, channels, page.bitspersample)
        tags = Image.Exif()
        tags.bigtiff, tags.endian = tiff.is_bigtiff, tiff.byteorder
        tags.load_from_fp(stream, page.offset)
        exif = own_exif(tags)
    exif[_ORIENTATION] = tags.get(_ORIENTATION, 1)
    info = {"icc_profile": tags.get(_PROFILE), "xmp": tags.get(_XMP), "black_level": tags.get(_BLACK_LEVEL)}
    if (per := _INCHES.get(tags.get(_RESOLUTION_UNIT, 2))) and tags.get(_RESOLUTION[0]):
        info["dpi"] = tuple((finite(tags.get(tag)) or math.nan) * per for tag in _RESOLUTION)
    metadata = _metadata(exif, info, size, page.bitspersample, channels)
    return replace(metadata, pixel_size=None if told is None else told.pixel_size, planes=planes)


def _raw_metadata(file: Path) -> Metadata:
    """Metadata of a raw file, which is read upright."""
    size = raw_size(file)
    # A small image carries the tags; its focal length is in its own pixels.
    header = Image.new("L", (max(1, size[0] // _HEADER), max(1, size[1] // _HEADER)))
    header.info["exif"] = raw_exif(file).tobytes()
    metadata = metadata_of(header)
    focal = None if metadata.focal_px is None else metadata.focal_px * size[0] / header.width
    return replace(metadata, size=size, bit_depth=16, orientation=1, focal_px=focal)


def metadata_of(image: Image.Image) -> Metadata:
    """Metadata of an image that Pillow has opened."""
    # First, since looking for EXIF at the end of a PNG file decodes it, and Pillow then forgets.
    bit_depth = _bit_depth(image)
    return _metadata(image.getexif(), image.info, image.size, bit_depth, _channels(image))


def _metadata(
    exif: Image.Exif, info: Mapping[Any, Any], size: tuple[int, int], bit_depth: int, channels: int
) -> Metadata:
    """Metadata by EXIF and by what Pillow calls the info of an image whose pixels are stored in a size."""
    orientation = _orientation(exif.get(_ORIENTATION))
    photo = exif.get_ifd(ExifTags.IFD.Exif)
    xmp = xmp_text(info)
    gps, gps_problem = _gps(exif.get_ifd(ExifTags.IFD.GPSInfo), xmp)
    dpi = info.get("dpi")
    profile, profile_lost = _colour_profile(info.get("icc_profile"))
    return Metadata(
        size=turned_size(size, orientation),
        bit_depth=bit_depth,
        orientation=orientation,
        focal_px=_focal_px(photo, xmp, size),
        gps=gps,
        gps_problem=gps_problem,
        attitude=read_attitude(xmp),
        make=_text(exif.get(ExifTags.Base.Make)),
        model=_text(exif.get(ExifTags.Base.Model)),
        serial=_text(photo.get(ExifTags.Base.BodySerialNumber)) or _text(exif.get(ExifTags.Base.CameraSerialNumber)),
        dpi=(float(dpi[0]), float(dpi[1])) if dpi and all(finite(d) for d in dpi) else None,
        exposure=_exposure(photo),
        radiometry=read_radiometry(xmp, info.get("black_level"), bit_depth),
        timestamp=_timestamp(photo),
        exif=_clean_exif(exif, size[0]),
        icc_profile=profile,
        profile_lost=profile_lost,
        channels=channels,
    )


def _exposure(photo: Mapping[int, Any]) -> float | None:
    """Exposure time x sensitivity / f-number²; without a number or a sensitivity, these are taken to be constant."""
    time, aperture, speed = (photo.get(tag) for tag in _EXPOSURE_TAGS)
    speed = speed[0] if isinstance(speed, tuple) and speed else speed
    seconds, number, sensitivity = finite(time), finite(aperture or 1.0), finite(speed or 100.0)
    if not (seconds and number and sensitivity and min(seconds, number, sensitivity) > 0.0):
        return None
    return seconds * sensitivity / number**2


def _bit_depth(image: Image.Image) -> int:
    """Bits per sample as stored; Pillow shows 16-bit colour PNG as 8-bit."""
    pieces = getattr(image, "tile", None)
    if image.format == "PNG" and pieces and "16" in str(pieces[0][3]):
        return 16
    return _BIT_DEPTHS.get(image.mode, 8)


def _orientation(value: Any) -> int:
    """EXIF orientation, also where a program has stored it as text or as a float; 1 where it means nothing."""
    if isinstance(value, tuple) and value:
        value = value[0]
    number = finite(_text(value) if isinstance(value, bytes) else value)
    return 1 if number is None or number not in range(1, 9) else int(number)


def _colour_profile(profile: object) -> tuple[bytes, str]:
    """The colour profile, or why it is not kept."""
    if not isinstance(profile, bytes):
        return b"", ""
    if len(profile) > MAX_PROFILE:
        return b"", f"its colour profile of {len(profile) / 1e6:.1f} MB is too large for PNG readers"
    if profile[_COLOUR_SPACE] == b"CMYK":
        return b"", "" if ink_transform(profile) else "its colour profile of inks (CMYK) cannot be used"
    if profile[_COLOUR_SPACE] == b"Lab ":
        return b"", ""
    return profile, ""


def _channels(image: Image.Image) -> int:
    """Samples per pixel of what it is decoded to."""
    if image.mode not in ("P", "PA"):
        return len(image.getbands())
    return (1 if is_grey_palette(image) else 3) + ("transparency" in image.info or image.mode == "PA")


def is_grey_palette(image: Image.Image) -> bool:
    """Check whether a palette holds shades of grey only."""
    palette = np.array(image.getpalette("RGB") or [], dtype=np.uint8).reshape(-1, 3)
    return bool((palette == palette[:, :1]).all())


def _text(value: Any) -> str:
    """Printable text of a tag that may be bytes, padded with zeros, or absent."""
    text = value.decode("latin-1") if isinstance(value, bytes) else str(value or "")
    return text.split("\0")[0].strip()


def _focal_px(photo: Mapping[int, Any], xmp: str, size: tuple[int, int]) -> float | None:
    """Focal length in pixels, by the most direct tag that has one; None where tags contradict one another."""
    calibrated, middle = (xmp_number(xmp, name) for name in ("CalibratedFocalLength", "CalibratedOpticalCenterX"))
    focal = finite(photo.get(ExifTags.Base.FocalLength))
    resolution = finite(photo.get(ExifTags.Base.FocalPlaneXResolution))
    unit = _MM_PER_RESOLUTION_UNIT.get(photo.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    equivalent = finite(photo.get(ExifTags.Base.FocalLengthIn35mmFilm))
    # Pixels of the original, which a resized image keeps the tags of; it is not read of a middle that is beside it.
    width = finite(photo.get(_PIXEL_WIDTH)) or size[0]
    calibrated_width = width if not middle or abs(math.log(2.0 * middle / width)) < _BESIDE else 2.0 * middle
    found = [
        calibrated * size[0] / calibrated_width if calibrated else None,
        focal * resolution / unit * size[0] / width if focal and resolution and unit else None,
        equivalent / _DIAGONAL_35MM * math.hypot(*size) if equivalent else None,
    ]
    known = [value for value in found if value and value > 0.0 and is_focal_length(value, size)]
    return known[0] if known and max(known) <= _CONTRADICTION * min(known) else None


def _timestamp(photo: Mapping[int, Any]) -> float | None:
    """Seconds since 1970 by the EXIF tags of when the image was taken."""
    text, zone = _text(photo.get(ExifTags.Base.DateTimeOriginal)), _text(photo.get(ExifTags.Base.OffsetTimeOriginal))
    fraction = _text(photo.get(ExifTags.Base.SubsecTimeOriginal))
    for zoned in (f"{text}{zone or '+00:00'}", f"{text}+00:00"):
        with suppress(ValueError, OverflowError):
            whole = datetime.strptime(zoned, "%Y:%m:%d %H:%M:%S%z").timestamp()
            return whole + (float(f"0.{fraction}") if fraction.isdecimal() else 0.0)
    return None


def _gps(tags: dict[int, Any], xmp: str) -> tuple[GpsPosition | None, str]:
    """Position from the GPS block with accuracies of XMP, or None where it is absent or impossible, and why."""
    sides = [_text(tags.get(tag)).upper()[:1] for tag in (ExifTags.GPS.GPSLatitudeRef, ExifTags.GPS.GPSLongitudeRef)]
    latitude = _degrees(tags.get(ExifTags.GPS.GPSLatitude), sides[0] == "S")
    longitude = _degrees(tags.get(ExifTags.GPS.GPSLongitude), sides[1] == "W")
    if latitude is None or longitude is None or abs(latitude) > 90 or abs(longitude) > 180:
        return None, ""
    if latitude == longitude == 0.0:  # what receivers write that have no fix
        return None, ""
    if sides[0] not in ("N", "S") or sides[1] not in ("E", "W"):
        return None, "its GPS position does not say whether north or south, east or west"
    altitude = finite(tags.get(ExifTags.GPS.GPSAltitude))
    below_sea = tags.get(ExifTags.GPS.GPSAltitudeRef) in (1, b"\x01")
    accuracies = (("RtkStdLat", "RtkStdLon", "RtkStdHgt"), ("GPSXYAccuracy", "GPSXYAccuracy", "GPSZAccuracy"))
    told = [[xmp_number(xmp, name) or 0.0 for name in names] for names in accuracies]
    along, across, up = next((each for each in told if min(each) > 0.0), (0.0, 0.0, 0.0))
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


def _clean_exif(exif: Image.Exif, width: int) -> bytes:
    """EXIF for the output: what orientation, size and maker note said is no longer true of it.

    The resolution of the focal plane counts pixels of the size that EXIF says; ``width`` is that of the image.
    """
    if not len(exif):
        return b""

    def clean(kept: Image.Exif) -> None:
        photo = kept.get_ifd(ExifTags.IFD.Exif)
        original = finite(photo.get(_PIXEL_WIDTH))
        for tag in (ExifTags.Base.FocalPlaneXResolution, ExifTags.Base.FocalPlaneYResolution):
            if original and (resolution := finite(photo.get(tag))) and original != width:
                photo[tag] = resolution * width / original
        for gone in (_PIXEL_WIDTH, _PIXEL_HEIGHT, _MAKER_NOTE):
            photo.pop(gone, None)

    # First, since what is not of the type that belongs to it cannot be written.
    exif[_ORIENTATION] = 1
    try:
        data = exif.tobytes()
    except _UNWRITABLE:
        return b""
    return _edited(data, clean)


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
