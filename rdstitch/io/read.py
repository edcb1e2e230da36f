"""Reading an image: any common file to an array in RGB order, upright, with its alpha and metadata."""

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import simplejpeg
from PIL import Image

from rdstitch.arrays import AnyArray, UInt8Array
from rdstitch.errors import InputError
from rdstitch.geometry.exif_orientation import turned
from rdstitch.io.colour import without_inks
from rdstitch.io.metadata import GREY_16, Metadata, is_grey, is_transparent, metadata_of, read_metadata
from rdstitch.io.opening import (
    DEEP_MODES,
    PNG_MAGIC,
    TIFF_MAGIC,
    check_readable,
    decoding,
    is_raw,
    opened_image,
    reader_package,
)
from rdstitch.io.raw import read_raw
from rdstitch.io.read_tiff import as_opacity, first_image_pages, read_page
from rdstitch.io.reduction import block_mean, block_minimum, reduced_size
from rdstitch.io.samples import OPAQUE, ROWS_AT_A_TIME, as_alpha, split_alpha
from rdstitch.system.file_access import open_regular, read_beginning
from rdstitch.system.late_imports import imagecodecs, tifffile
from rdstitch.system.native_threads import silent_opencv

_MAX_DECODED_REDUCTION = 8  # of the JPEG decoder
_JPEG = ("JPEG", "MPO")
_END_OF_IMAGE = b"\xff\xd9"
_PADDING = re.compile(r"(\d+) extraneous bytes before marker 0xd9")
_MIN_SIDE = 8  # pixels of a JPEG image; below, different reductions give images of the same size


@dataclass(frozen=True, eq=False)
class DecodedImage:
    """One image in memory."""

    # (height, width) or (height, width, channels): uint8, uint16 or float32. Colour is in RGB order, never BGR. The
    # EXIF orientation has been applied
    pixels: AnyArray
    # (height, width), uint8: 255 where the image is opaque, 0 where it says nothing; None when it is opaque everywhere
    alpha: UInt8Array | None
    metadata: Metadata
    # why some of the pixels may be wrong: the complaint of a decoder that went on nevertheless. Empty without one
    damage: str = ""

    @property
    def nbytes(self) -> int:
        """Memory that its samples take, bytes."""
        return self.pixels.nbytes + (0 if self.alpha is None else self.alpha.nbytes)


def read_image(path: str | Path, reduction: int = 1, metadata: Metadata | None = None) -> DecodedImage:
    """Read an image file.

    JPEG, PNG, TIFF, WebP and whatever else Pillow reads, with 8 or 16 bit or floating-point samples; with optional
    packages also HEIC, and raw files, which become 16-bit sRGB. 10 and 12 bits become 16. Of an animated or multi-page
    file the first image counts. CMYK (by its profile), CIELAB and palette colours become RGB. NaN or infinite samples
    of a floating-point file become transparent zeros.

    Blocks of ``reduction`` pixels a side become one pixel, the last ones of what is there of them; the metadata stay
    those of the whole image. JPEG files are decoded at 1/2, 1/4 or 1/8 of the size, in a fraction of the time.
    ``metadata`` is what :func:`read_metadata` has found in the file, which is not looked for again.
    """
    file, factor, damage = Path(path), 1, ""
    check_readable(file)
    with decoding(file):
        with open_regular(file) as stream:
            magic = stream.read(len(PNG_MAGIC))
        if is_raw(file):
            samples, alpha = read_raw(file), None
        elif magic[:4] in TIFF_MAGIC:
            samples, alpha = _read_tiff(file)
        else:
            with opened_image(file) as opened:
                metadata = metadata or metadata_of(opened)
                if metadata.bit_depth > 8 and opened.mode in DEEP_MODES:
                    samples, alpha = split_alpha(_deep_samples(file, opened, metadata.bit_depth))
                else:
                    factor, decoded = _decoder_reduction(opened, metadata, reduction), None
                    if opened.format in _JPEG and opened.mode in ("L", "RGB"):
                        decoded, damage = decoded_jpeg(file, opened.size, factor, grey=opened.mode == "L")
                    samples, alpha = from_pillow(opened, factor) if decoded is None else (decoded, None)
        image = as_image(file, samples, alpha, metadata or read_metadata(file))
        return reduced(replace(image, damage=damage), reduction // factor)


def _deep_samples(file: Path, image: Image.Image, bits: int) -> AnyArray:
    """Colours of more than 8 bits, which Pillow would cut to 8, in 16."""
    samples: Any
    if image.format == "HEIF":
        with open_regular(file) as stream:
            package = reader_package("pillow_heif", file)
            samples = np.asarray(package.open_heif(stream, convert_hdr_to_8bit=False)) >> (16 - bits)
    else:
        data = read_beginning(file, _most_bytes(image.size))
        if image.format == "PPM":
            with silent_opencv():  # to which the last number ends with its line
                samples = cv2.imdecode(np.frombuffer(data + b"\n", np.uint8), cv2.IMREAD_UNCHANGED)
            if samples is None:
                raise ValueError("not enough image data")
            samples = samples[..., ::-1]
        elif image.format == "AVIF":
            samples = imagecodecs.avif_decode(data, index=0)
        else:
            samples = (imagecodecs.png_decode if image.format == "PNG" else imagecodecs.jpeg2k_decode)(data)
    return np.asarray(samples << (16 - bits) | samples >> (2 * bits - 16))


def reduced(image: DecodedImage, factor: int) -> DecodedImage:
    """Blocks of ``factor`` pixels a side become one pixel, transparent where any of them is; the metadata stay."""
    if factor == 1:
        return image
    alpha = None if image.alpha is None else block_minimum(image.alpha, factor)
    return replace(image, pixels=block_mean(image.pixels, factor), alpha=alpha)


def decoded_jpeg(file: Path, size: tuple[int, int], factor: int, *, grey: bool) -> tuple[AnyArray | None, str]:
    """Samples of 1/``factor`` of the size, (h, w) or (h, w, 3) in RGB order as stored, and what is wrong with the file.

    What Pillow would decode, bit for bit, in less time and memory. Pillow has the last word on files about which
    the decoder has any complaint: it refuses some, and decodes others without a word, whatever comes out. Then, and
    where the file has no such reduction or is tiny, there are no samples; complaints that say nothing of the pixels
    are empty.
    """
    if min(size) < _MIN_SIDE:
        return None, ""
    width, height = reduced_size(size, factor)
    data = read_beginning(file, _most_bytes(size))
    try:
        samples = simplejpeg.decode_jpeg(
            data, "GRAY" if grey else "RGB", min_height=height, min_width=width, strict=True
        )
    except ValueError as error:
        return None, "" if _is_padding(str(error), data) else str(error)
    whole: AnyArray = np.asarray(samples)[..., 0] if grey else np.asarray(samples)
    return (whole if whole.shape[:2] == (height, width) else None), ""


def _most_bytes(size: tuple[int, int]) -> int:
    """How much of a file an image can take, with what stands before it; a video may follow, or a hole without end."""
    return 2**26 + 16 * size[0] * size[1]


def _is_padding(complaint: str, data: bytes) -> bool:
    """Check whether the decoder only complains of zeros before the end, as some cameras write them."""
    padding = _PADDING.search(complaint)
    end = data.rfind(_END_OF_IMAGE)
    return padding is not None and not data[max(0, end - int(padding[1])) : end].strip(b"\0\xff")


def _decoder_reduction(image: Image.Image, metadata: Metadata, reduction: int) -> int:
    """The part of a reduction by which the decoder can make the image smaller; 1 for nothing."""
    factor = math.gcd(reduction, _MAX_DECODED_REDUCTION)
    # Blocks begin at the stored image's first pixel; in one that is to be mirrored they must end at its last.
    crosswise = metadata.orientation != 1 and any(n % factor for n in image.size)
    return 1 if image.format not in _JPEG or min(image.size) < factor or crosswise else factor


def from_pillow(image: Image.Image, factor: int = 1) -> tuple[AnyArray, AnyArray | None]:
    """Samples and alpha of any mode of Pillow's, by such a share of the decoder smaller."""
    if factor > 1:
        wanted = reduced_size(image.size, factor)
        image.draft(None, (image.size[0] // factor, image.size[1] // factor))
        if image.size != wanted:
            raise ValueError(f"cannot be decoded at 1/{factor} of its size")
    if image.mode in GREY_16:
        samples, clear = _samples(image).astype(np.uint16), image.info.get("transparency")
        return samples, None if clear is None else as_alpha(samples != clear)
    if image.mode == "F":
        return _samples(image), None
    transparent, grey = is_transparent(image), is_grey(image)
    image = without_inks(image)
    mode = "RGBA" if transparent else "L" if grey else "RGB"
    samples = _samples(image if image.mode == mode else image.convert(mode))
    if not transparent:
        return samples, None
    return (samples[..., 0] if grey else samples[..., :3]), samples[..., 3]


def _samples(image: Image.Image) -> AnyArray:
    """The samples of an image, taken in pieces: Pillow's own conversion holds them three times."""
    image.load()
    width, height = image.size
    first = np.asarray(image.crop((0, 0, width, min(ROWS_AT_A_TIME, height))))
    samples = np.empty((height, *first.shape[1:]), dtype=first.dtype)
    for top in range(0, height, ROWS_AT_A_TIME):
        bottom = min(top + ROWS_AT_A_TIME, height)
        samples[top:bottom] = np.asarray(image.crop((0, top, width, bottom)))
    return samples


def _read_tiff(file: Path) -> tuple[AnyArray, AnyArray | None]:
    """Samples and alpha of the first page, or of the channels of a microscope."""
    with open_regular(file) as stream, tifffile.TiffFile(stream, name=str(file)) as tiff:
        pages = first_image_pages(tiff)
        if len(pages) == 1:
            return read_page(tiff, pages[0])
        return np.stack([page.asarray() for page in pages], axis=-1), None


def as_image(file: Path, samples: AnyArray, alpha: AnyArray | None, metadata: Metadata) -> DecodedImage:
    """An image from samples as stored: upright, in one of the three sample types, contiguous, and without NaN."""
    if samples.size == 0:
        raise InputError(f"{file}: has no pixels")
    opaque = None
    if alpha is not None:
        opaque = as_opacity(alpha, np.iinfo(alpha.dtype).max if alpha.dtype.kind in "ui" else 1.0)
    if samples.dtype not in (np.uint8, np.uint16):
        samples = samples.astype(np.float32)
        finite = np.isfinite(samples)
        valid = finite if samples.ndim == 2 else finite.all(axis=2)
        if not valid.all():
            samples = np.where(finite, samples, np.float32(0.0))
            opaque = np.where(valid, np.uint8(OPAQUE) if opaque is None else opaque, np.uint8(0))
    if opaque is not None:
        whole = bool((opaque == OPAQUE).all())
        opaque = None if whole else np.ascontiguousarray(turned(opaque, metadata.orientation))
    return DecodedImage(np.ascontiguousarray(turned(samples, metadata.orientation)), opaque, metadata)
