"""What an image file says about itself: size, lens, place, attitude, camera; read without decoding pixels."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
from PIL import ExifTags, Image

from rdstitch.geometry.exif_orientation import turned_size, turning_matrix
from rdstitch.geometry.places import GpsPosition
from rdstitch.io.attitude import Attitude, finite, read_attitude, xmp_text
from rdstitch.io.colour import transform_to_srgb
from rdstitch.io.exif import (
    author_and_time,
    exposure_of,
    focal_length,
    gps_position,
    orientation_of,
    tag_text,
    time_taken,
    upright_exif,
    without_film_size,
)
from rdstitch.io.ome import read_ome
from rdstitch.io.opening import (
    TIFF_MAGIC,
    check_decoded_size,
    check_readable,
    decoding,
    has_late_metadata,
    is_raw,
    opened_image,
    stored_bits,
)
from rdstitch.io.radiometric_tags import Radiometry, read_radiometry
from rdstitch.io.raw import own_exif, raw_exif, raw_size
from rdstitch.io.read_tiff import channel_count, first_image_pages
from rdstitch.system.file_access import open_regular
from rdstitch.system.late_imports import tifffile

_MAX_DPI = 1e6

MAX_PROFILE = 2**20 - 2**10
"""Bytes of a colour profile: PNG readers, such as Pillow's, refuse images whose profile takes a megabyte."""

_EXIF_OF_PNG = {"exif", "Raw profile type exif"}
GREY_16 = ("I;16", "I;16B", "I;16L", "I;16N", "I")  # modes of Pillow's
_COLOUR_SPACE = slice(16, 20)  # of a profile's header
_INCHES = {2: 1.0, 3: 2.54}  # what pixels per unit are multiplied by


@dataclass(frozen=True)
class Metadata:
    """Everything known of an image file beside its pixels."""

    size: tuple[int, int]  # width and height, pixels, after the EXIF orientation is applied
    bit_depth: int = 8  # bits per sample
    # EXIF orientation (1 to 8) stored in the file; readers of this project have applied it already
    orientation: int = 1
    focal_px: float | None = None  # focal length, pixels, where the file tells it
    focal_mm: float | None = None  # the same, millimetres, which crops and resizing leave as it is
    gps: GpsPosition | None = None
    gps_problem: str = ""  # why the position in the file is not used; empty where it is, or where there is none
    attitude: Attitude | None = None
    make: str = ""  # make, model, serial: of the camera; empty where not known
    model: str = ""
    serial: str = ""
    dpi: tuple[float, float] | None = None  # across and down, as the file says it, which may be impossible
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

    @property
    def resolution(self) -> tuple[float, float] | None:
        """Its dpi where files can say that; None elsewhere."""
        return self.dpi if self.dpi is not None and all(0.0 < each < _MAX_DPI for each in self.dpi) else None

    def with_samples(self, channels: int) -> Self:
        """Metadata of an image of so many channels; a colour profile of grey samples is none of colours."""
        grey = self.icc_profile[_COLOUR_SPACE] == b"GRAY"
        return replace(self, icc_profile=b"") if grey and channels > 1 else self

    def in_another_size(self) -> Self:
        """Metadata of the same image at the same scale but cut or extended."""
        return replace(self, exif=without_film_size(self.exif))

    def scaled(self, scale: float | None) -> Self:
        """Metadata of an image of so many pixels for one; None where that is not known."""
        if scale is None:
            return replace(self, dpi=None, pixel_size=None)
        dpi = None if self.dpi is None else (self.dpi[0] * scale, self.dpi[1] * scale)
        return replace(self, dpi=dpi, pixel_size=None if self.pixel_size is None else self.pixel_size / scale)

    def of_composite(self) -> Self:
        """Metadata of an image made from several."""
        return replace(self, exif=author_and_time(self.exif))


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
        ome = read_ome(tiff.ome_metadata)
        pages = first_image_pages(tiff, ome)
        page, planes = pages[0], len(pages) > 1
        size, channels = (page.imagewidth, page.imagelength), len(pages) if planes else channel_count(page)
        if min(size) < 1:
            raise ValueError("no pixels")
        check_decoded_size(file, size, channels, page.bitspersample)
        tags = Image.Exif()
        tags.bigtiff, tags.endian = tiff.is_bigtiff, tiff.byteorder
        tags.load_from_fp(stream, page.offset)
        exif = own_exif(tags)
    exif[ExifTags.Base.Orientation] = tags.get(ExifTags.Base.Orientation, 1)
    tag = ExifTags.Base
    info = {"icc_profile": tags.get(tag.InterColorProfile), "xmp": tags.get(tag.XMLPacket)}
    info["black_level"] = tags.get(tag.BlackLevel)
    if (per := _INCHES.get(tags.get(tag.ResolutionUnit, 2))) and tags.get(tag.XResolution):
        info["dpi"] = tuple((finite(tags.get(along)) or math.nan) * per for along in (tag.XResolution, tag.YResolution))
    metadata = _metadata(exif, info, size, page.bitspersample, channels)
    return replace(metadata, pixel_size=None if ome is None else ome.pixel_size, planes=planes)


def _raw_metadata(file: Path) -> Metadata:
    size, orientation = raw_size(file)
    exif = raw_exif(file)
    exif[ExifTags.Base.Orientation] = orientation
    return _metadata(exif, {}, size, 16, 3)


def metadata_of(image: Image.Image) -> Metadata:
    """Metadata of an image that Pillow has opened."""
    # First, since looking for EXIF at the end of a PNG file decodes it, and Pillow then forgets.
    bit_depth = stored_bits(image)
    channels = (1 if is_grey(image) else 3) + is_transparent(image)
    return _metadata(image.getexif(), image.info, image.size, bit_depth, channels)


def _metadata(
    exif: Image.Exif, info: Mapping[Any, Any], size: tuple[int, int], bit_depth: int, channels: int
) -> Metadata:
    """Metadata by EXIF and by what Pillow calls the info of an image whose pixels are stored in a size."""
    orientation = orientation_of(exif.get(ExifTags.Base.Orientation))
    photo = exif.get_ifd(ExifTags.IFD.Exif)
    xmp = xmp_text(info)
    gps, gps_problem = gps_position(exif.get_ifd(ExifTags.IFD.GPSInfo), xmp)
    dpi = info.get("dpi")
    profile, profile_lost = _colour_profile(info.get("icc_profile"))
    serials = photo.get(ExifTags.Base.BodySerialNumber), exif.get(ExifTags.Base.CameraSerialNumber)
    return Metadata(
        size=turned_size(size, orientation),
        bit_depth=bit_depth,
        orientation=orientation,
        focal_px=focal_length(photo, xmp, size),
        focal_mm=finite(photo.get(ExifTags.Base.FocalLength)) or None,
        gps=gps,
        gps_problem=gps_problem,
        attitude=read_attitude(xmp),
        make=tag_text(exif.get(ExifTags.Base.Make)),
        model=tag_text(exif.get(ExifTags.Base.Model)),
        serial=next(filter(None, map(tag_text, serials)), ""),
        dpi=turned_size((float(dpi[0]), float(dpi[1])), orientation) if dpi and all(finite(d) for d in dpi) else None,
        exposure=exposure_of(photo),
        radiometry=read_radiometry(xmp, info.get("black_level"), bit_depth),
        timestamp=time_taken(photo),
        exif=upright_exif(exif, size[0]),
        icc_profile=profile,
        profile_lost=profile_lost,
        channels=channels,
    )


def _colour_profile(profile: object) -> tuple[bytes, str]:
    """The colour profile, or why it is not kept."""
    if not isinstance(profile, bytes):
        return b"", ""
    if len(profile) > MAX_PROFILE:
        return b"", f"its colour profile of {len(profile) / 1e6:.1f} MB is too large for PNG readers"
    if profile[_COLOUR_SPACE] == b"CMYK":
        return b"", "" if transform_to_srgb(profile) else "its colour profile of inks (CMYK) cannot be used"
    if profile[_COLOUR_SPACE] == b"Lab ":
        return b"", ""
    return profile, ""


def is_transparent(image: Image.Image) -> bool:
    """Check for alpha, or a colour that stands for it."""
    return "a" in image.mode.lower().removeprefix("lab") or "transparency" in image.info


def is_grey(image: Image.Image) -> bool:
    """Check for grey samples, or a palette that holds shades of grey only."""
    if image.mode not in ("P", "PA"):
        return image.mode in (*GREY_16, "1", "L", "LA", "La", "F")
    palette = np.array(image.getpalette("RGB") or [], dtype=np.uint8).reshape(-1, 3)
    return bool((palette == palette[:, :1]).all())
