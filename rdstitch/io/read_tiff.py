"""Which pages of a TIFF file are its images, and their samples, whatever their compression: by the tags alone.

The photometric interpretation says how many bands are colour, ExtraSamples which of the others is alpha; all others are
data. An internal mask (a page of its own, as GDAL writes it), GDAL's NODATA and alpha say together where there is
something.
"""

from collections.abc import Iterator
from itertools import islice

import numpy as np
from PIL import ExifTags, Image

from rdstitch.arrays import AnyArray, BoolArray, UInt8Array
from rdstitch.io.colour import srgb_of_lab, without_inks
from rdstitch.io.ome import OmeImage, read_ome
from rdstitch.io.samples import OPAQUE, ROWS_AT_A_TIME, as_alpha
from rdstitch.system.late_imports import tifffile

_MASK, _MASK_WITHIN = 4, 40  # the kind of a page that masks the image, and how many pages are looked at for one
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _PALETTE, _STENCIL, _INKS, _YCBCR = range(7)
_LAB, _ICC_LAB, _LINEAR_RAW = 8, 9, 34892
# Bands that are colour, by photometric interpretation.
_COLOURS = {
    **dict.fromkeys((_WHITE_IS_ZERO, _BLACK_IS_ZERO, _PALETTE, _STENCIL), 1),
    **dict.fromkeys((_RGB, _YCBCR, _LAB, _ICC_LAB, _LINEAR_RAW), 3),
    _INKS: 4,
}
_INDIRECT = (_PALETTE, _INKS)  # become 8-bit RGB, beside which their other bands say nothing
_ASSOCIATED, _UNASSOCIATED = 1, 2  # alpha; colours of the first are multiplied by it
_JPEG = (6, 7, 33007, 34892)  # compressions whose decoders make RGB of YCbCr
_NODATA = 42113


def image_pages(tiff: "tifffile.TiffFile") -> Iterator["tifffile.TiffPage"]:
    """The pages of a file that are images of their own; the first page always is."""
    yield tiff.pages.first
    for number in range(1, len(tiff.pages)):  # which goes through the whole file
        page = tiff.pages[number].aspage()
        if not (page.is_reduced or page.is_mask):
            yield page


def first_image_pages(tiff: "tifffile.TiffFile", ome: OmeImage | None = None) -> list["tifffile.TiffPage"]:
    """The pages of the first image: one, or those of all channels where an OME-TIFF has these on pages of their own."""
    ome = ome or read_ome(tiff.ome_metadata)
    count = 1 if ome is None else max(1, ome.channels)
    pages = list(islice(image_pages(tiff), count))
    alike = len({(page.shape, page.dtype) for page in pages}) == 1 and pages[0].axes == "YX"
    return pages if len(pages) == count and alike else pages[:1]


def channel_count(page: "tifffile.TiffPage") -> int:
    """Bands of what a page is decoded to, with alpha."""
    if page.photometric == _PALETTE:
        table = np.asarray(page.colormap)
        return 1 if (table == table[:1]).all() else 3
    return 3 if page.photometric == _INKS else int(page.samplesperpixel)


def read_page(tiff: "tifffile.TiffFile", page: "tifffile.TiffPage") -> tuple[AnyArray, UInt8Array | None]:
    """Samples (h, w) or (h, w, bands) of a page as stored, colours as grey or RGB, and its alpha."""
    kind, bits = int(page.photometric), page.bitspersample
    if kind not in _COLOURS or page.dtype is None or page.dtype.kind not in "buif":
        raise ValueError(f"photometric interpretation {kind} with samples of type {page.dtype} is not read")
    stored, axes = page.asarray(), page.axes
    if axes.startswith("S"):
        stored, axes = np.moveaxis(stored, 0, -1), axes[1:] + "S"
    if axes not in ("YX", "YXS"):
        raise ValueError(f"unexpected axes {axes}")
    stored = stored if axes == "YXS" else stored[..., None]
    if stored.shape[2] < (count := _COLOURS[kind]):
        raise ValueError(f"has {stored.shape[2]} of {count} bands")
    full = 2**bits - 1 if stored.dtype.kind in "bu" else np.iinfo(stored.dtype).max if stored.dtype.kind == "i" else 1.0
    masks = [_mask(tiff, page)]
    colours, data = stored[..., :count], stored[..., count:]
    alphas = [n for n, meaning in enumerate(page.extrasamples) if meaning in (_ASSOCIATED, _UNASSOCIATED)]
    if alphas:
        alpha, data = data[..., alphas[0]], np.delete(data, alphas[0], axis=2)
        if page.extrasamples[alphas[0]] == _ASSOCIATED:
            colours = _straight(colours, alpha, full)
        masks.append(as_opacity(alpha, full))
    if (empty := _lacks_data(page, colours, data)) is not None:
        colours[empty] = data[empty] = 0
        masks.append(as_alpha(~empty))
    samples = _grey_or_rgb(page, kind, colours, full)
    if kind not in _INDIRECT:
        if data.shape[2]:
            samples = np.concatenate([samples, data], axis=2)
        if stored.dtype.kind in "bu" and full < OPAQUE:
            samples = np.rint(samples * (OPAQUE / full)).astype(np.uint8)
    given = [mask for mask in masks if mask is not None]
    return samples[..., 0] if samples.shape[2] == 1 else samples, np.minimum.reduce(given) if given else None


def _grey_or_rgb(page: "tifffile.TiffPage", kind: int, colours: AnyArray, full: float) -> AnyArray:
    """Grey or RGB (h, w, 1 or 3) of the bands that are colour, in the type they are stored in."""
    integers = colours.dtype in (np.uint8, np.uint16)
    if kind == _WHITE_IS_ZERO:
        return ~colours if colours.dtype == np.bool_ else full - colours if colours.dtype.kind == "u" else -colours
    if kind == _PALETTE:
        table = np.asarray(page.colormap).T[:, : channel_count(page)]
        # Some programs write 8 bits where there should be 16.
        table = (table if table.max() <= OPAQUE else table >> 8).astype(np.uint8)
        return table[colours[..., 0].astype(np.intp)]
    if kind in (_LAB, _ICC_LAB, _INKS) and not integers:
        raise ValueError(f"photometric interpretation {kind} with samples of type {colours.dtype} is not read")
    if kind in (_LAB, _ICC_LAB):
        return srgb_of_lab(colours, signed=kind == _LAB)
    if kind == _INKS or (kind == _YCBCR and page.compression not in _JPEG):
        return _by_pillow(page, colours, "CMYK" if kind == _INKS else "YCbCr")
    return colours


def _by_pillow(page: "tifffile.TiffPage", colours: AnyArray, mode: str) -> AnyArray:
    """8-bit RGB of inks, by their colour profile where there is one, or of YCbCr."""
    if colours.dtype == np.uint16:
        colours = (colours >> 8).astype(np.uint8)
    image = Image.frombytes(mode, colours.shape[1::-1], colours.tobytes())
    profile = page.tags.get(int(ExifTags.Base.InterColorProfile))
    if profile is not None:
        image.info["icc_profile"] = profile.value
    return np.asarray(without_inks(image).convert("RGB"))


def _straight(colours: AnyArray, alpha: AnyArray, full: float) -> AnyArray:
    """Colours that were multiplied by alpha without it; black where it is 0."""
    straight = np.empty_like(colours)
    for top in range(0, len(colours), ROWS_AT_A_TIME):
        rows = slice(top, top + ROWS_AT_A_TIME)
        opacity = np.maximum(alpha[rows, :, None] / full, 0.0)
        values = np.divide(colours[rows], opacity, out=np.zeros(colours[rows].shape), where=opacity > 0.0)
        straight[rows] = np.rint(np.clip(values, 0, full)) if colours.dtype.kind in "ui" else values
    return straight


def _mask(tiff: "tifffile.TiffFile", page: "tifffile.TiffPage") -> UInt8Array | None:
    """The alpha of the page's internal mask, a page of the same size beside it."""
    pages = (other for other in tiff.pages[1:_MASK_WITHIN] if isinstance(other, tifffile.TiffPage))
    for other in pages:
        same = (other.imagelength, other.imagewidth) == (page.imagelength, page.imagewidth)
        if other.subfiletype == _MASK and same and other.samplesperpixel == 1:
            stored = other.asarray()
            return as_opacity(stored, 2**other.bitspersample - 1)
    return None


def _lacks_data(page: "tifffile.TiffPage", *bands: AnyArray) -> BoolArray | None:
    """Where a page has GDAL's NODATA; of counts, where all bands have it, since in one it may be part of a colour."""
    tag, kind = page.tags.get(_NODATA), bands[0].dtype.kind
    try:
        number = float(str(tag.value).strip("\0 ")) if tag is not None else np.nan
        nodata = bands[0].dtype.type(int(number) if kind in "bui" else number)
    except (ValueError, OverflowError):  # no number, or none that the samples can have
        return None
    equal = np.concatenate([part == nodata for part in bands], axis=2)
    return np.asarray(equal.all(axis=2) if kind in "bu" else equal.any(axis=2))


def as_opacity(alpha: AnyArray, full: float) -> UInt8Array:
    """Alpha of any sample type, which is ``full`` where the image is opaque, as 0..255."""
    if alpha.dtype == np.uint8 and full == OPAQUE:
        return np.asarray(alpha, dtype=np.uint8)
    opacity = np.clip(np.nan_to_num(alpha.astype(np.float32) / full), 0.0, 1.0)
    return np.asarray(np.rint(opacity * OPAQUE), dtype=np.uint8)
