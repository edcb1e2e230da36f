"""TIFF from strips: compressed, BigTIFF where needed, with overviews of half the size again and again.

Grey samples with alpha are something that OpenCV (4.11 to 5.0) reads as stripes or reduces to 8 bits, and that Pillow
does not read where they are deeper; their transparency is a mask on a page of its own, as GDAL writes it, and every
program reads the first page. Where there are overviews, the file is in the order of a Cloud Optimized GeoTIFF.

Overviews are made while the strips pass, and wait in temporary files beside the output until their turn; memory is that
of one strip, whatever the size of the image.
"""

import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import deflate
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from rdstitch.io.cloud_tiff import put_in_order
from rdstitch.io.layout import STRIP_ROWS, Layout, Strip, with_alpha
from rdstitch.io.metadata import Metadata
from rdstitch.io.reduction import halved
from rdstitch.late_imports import tifffile

TILE = 256
_REDUCED, _MASK = 1, 4  # kinds of pages (NewSubfileType)
# Smaller images need no overview.
_MIN_OVERVIEW = 256
# Rows that are reduced at a time, even.
_HALVED_ROWS = 32
_BUFFER = 2**24
_LEVEL = 1  # of 1 to 12: 2 takes 1.7 times as long and makes files 2 % smaller
_BIGTIFF_FROM = 2**32 - 2**27
_XMP = 700
_COPIED_TAGS = (ExifTags.Base.Make, ExifTags.Base.Model, ExifTags.Base.Artist, ExifTags.Base.Copyright)
# (code, type, count, value, only on the first page), as tifffile takes them.
ExtraTag = tuple[int, int, int, Any, bool]


def write_tiff(path: Path, layout: Layout, strips: Iterable[Strip], extra_tags: Iterable[ExtraTag] = ()) -> None:
    """Write a TIFF file whose first page is the image and whose other pages are its overviews."""
    sizes = [layout.size, *overview_sizes(layout.size)]
    total = sum(w * h for w, h in sizes) * layout.samples_per_pixel * layout.dtype.itemsize
    joined: Iterable[NDArray[Any]] = (with_alpha(*strip) if layout.transparent else strip[0] for strip in strips)
    mask: list[bytes] | None = [] if _has_mask(layout) else None
    with ExitStack() as stack:
        tiff = stack.enter_context(tifffile.TiffWriter(path, bigtiff=total > _BIGTIFF_FROM))
        for level, size in enumerate(sizes):
            is_last = level + 1 == len(sizes)
            spill = None if is_last else stack.enter_context(tempfile.TemporaryFile(dir=path.parent))
            tags = [] if level else [*_copied_tags(layout.metadata), *extra_tags]
            passing = _spilling(joined, spill, layout.transparent)
            shown = passing if mask is None else _without_alpha(passing, mask)
            kind = _REDUCED if level else 0
            _write_page(tiff, layout, size, shown, tags, kind)
            if mask is not None:
                _write_mask(tiff, size, mask, kind | _MASK)
                mask.clear()
            if spill is not None:
                joined = _reread(spill, sizes[level + 1], layout)
    if len(sizes) > 1:
        put_in_order(path)


def _has_mask(layout: Layout) -> bool:
    """Whether transparency goes onto a page of its own."""
    return layout.transparent and layout.channels == 1


def _write_page(
    tiff: "tifffile.TiffWriter",
    layout: Layout,
    size: tuple[int, int],
    strips: Iterable[NDArray[Any]],
    tags: list[ExtraTag],
    kind: int,
) -> None:
    """Write one page from strips that hold all its samples."""
    width, height = size
    transparent = layout.transparent and not _has_mask(layout)
    samples = layout.channels + transparent
    colour = 3 if layout.channels == 3 else 1
    extra = ["unspecified"] * (layout.channels - colour) + ["unassalpha"] * transparent
    dpi = None if kind else layout.metadata.dpi
    tiff.write(
        (encoded_tile(tile) for tile in tiles_of(strips)),
        shape=(height, width, samples) if samples > 1 else (height, width),
        dtype=layout.dtype,
        photometric="rgb" if colour == 3 else "minisblack",
        planarconfig="contig" if samples > 1 else None,
        extrasamples=extra or None,
        tile=(TILE, TILE),
        compression="zlib",
        predictor=has_predictor(layout.dtype),
        # Tiles that tifffile holds before it writes them; 256 MB by default.
        buffersize=_BUFFER,
        metadata=None,
        software="rdstitch",
        subfiletype=kind,
        resolution=dpi,
        resolutionunit="inch" if dpi else None,
        iccprofile=None if kind else layout.metadata.icc_profile or None,
        extratags=tags,
    )


def _without_alpha(strips: Iterable[NDArray[Any]], mask: list[bytes]) -> Iterator[NDArray[Any]]:
    """The strips without alpha; tiles of where that is not 0, one bit a pixel, are added to ``mask`` as stored."""
    for strip in strips:
        bits = (np.packbits(tile[..., 0], axis=1) for tile in tiles_of([strip[..., -1:] > 0]))
        mask += [_deflated(tile) for tile in bits]
        yield strip[..., :-1]


def _write_mask(tiff: "tifffile.TiffWriter", size: tuple[int, int], tiles: list[bytes], kind: int) -> None:
    """Write the page that says where the page before it has an image."""
    tiff.write(
        iter(tiles),
        shape=size[::-1],
        dtype=np.bool_,
        photometric="mask",
        tile=(TILE, TILE),
        compression="zlib",
        metadata=None,
        software="rdstitch",
        subfiletype=kind,
    )


def tiles_of(strips: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """Tiles in the order of the file; those at the right and lower border completed."""
    for strip in strips:
        for y in range(0, strip.shape[0], TILE):
            for x in range(0, strip.shape[1], TILE):
                tile = strip[y : y + TILE, x : x + TILE]
                missing = [(0, TILE - n) for n in tile.shape[:2]] + [(0, 0)]
                yield np.pad(tile, missing) if any(b for _, b in missing) else tile


def has_predictor(dtype: np.dtype[Any]) -> bool:
    """Whether differences of neighbours are stored; what is usual for floating point, few programs can read."""
    return dtype.kind == "u"


def encoded_tile(tile: NDArray[Any]) -> bytes:
    """A tile (h, w, C) as it stands in the file."""
    stored = tile.copy()
    if has_predictor(tile.dtype):
        stored[:, 1:] -= tile[:, :-1]
    return _deflated(stored)


def _deflated(stored: NDArray[Any]) -> bytes:
    """Compressed by libdeflate, which is fast, and makes the same bytes of the same samples every time."""
    return bytes(deflate.zlib_compress(stored, _LEVEL))


def _spilling(strips: Iterable[NDArray[Any]], spill: IO[bytes] | None, transparent: bool) -> Iterator[NDArray[Any]]:
    """The strips; what passes is also written, half as large, to a file."""
    for strip in strips:
        # Before it is passed on: the writer does not come back after the last tile.
        if spill is not None:
            for top in range(0, len(strip), _HALVED_ROWS):
                spill.write(halved(strip[top : top + _HALVED_ROWS], transparent).data)
        yield strip


def _reread(spill: IO[bytes], size: tuple[int, int], layout: Layout) -> Iterator[NDArray[Any]]:
    """Strips from a file of plain samples, which is closed afterwards."""
    width, height = size
    row = width * layout.samples_per_pixel * layout.dtype.itemsize
    spill.seek(0)
    for top in range(0, height, STRIP_ROWS):
        rows = min(STRIP_ROWS, height - top)
        samples = np.frombuffer(spill.read(rows * row), dtype=layout.dtype)
        yield samples.reshape(rows, width, layout.samples_per_pixel)
    spill.close()


def _copied_tags(metadata: Metadata) -> Iterator[ExtraTag]:
    """XMP, and tags of the first image's EXIF that stay true of a mosaic."""
    if metadata.xmp:
        yield _XMP, 1, len(metadata.xmp), metadata.xmp, True
    if metadata.exif:
        exif = Image.Exif()
        exif.load(metadata.exif)
        for tag in _COPIED_TAGS:
            text = exif.get(tag)
            # Cameras pad with zeros, of which GDAL warns.
            text = text.split("\0")[0].strip() if isinstance(text, str) else ""
            if text and text.isascii():
                yield int(tag), 2, 0, text, True


def overview_sizes(size: tuple[int, int]) -> list[tuple[int, int]]:
    """Sizes of the overviews, each half of the one before, rounded up."""
    sizes = []
    width, height = size
    while max(width, height) > _MIN_OVERVIEW:
        width, height = -(-width // 2), -(-height // 2)
        sizes.append((width, height))
    return sizes
