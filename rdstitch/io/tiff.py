"""TIFF from strips: compressed, BigTIFF where needed, with overviews of half the size again and again.

Grey samples with alpha are something that OpenCV (4.11 to 5.0) reads as stripes or reduces to 8 bits, and that Pillow
does not read where they are deeper; their transparency is a mask on a page of its own, as GDAL writes it, and every
program reads the first page. Where there are overviews, the file is in the order of a Cloud Optimized GeoTIFF
(:mod:`rdstitch.io.tiff_order`).
"""

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from rdstitch.io.metadata import Metadata
from rdstitch.io.pyramid import pyramid, pyramid_sizes
from rdstitch.io.samples import as_alpha
from rdstitch.io.strips import ImageSpec, Strip, with_alpha
from rdstitch.io.tiff_order import put_in_order
from rdstitch.results.messages import Message
from rdstitch.system.ahead import in_order_ahead
from rdstitch.system.late_imports import imagecodecs, tifffile

TILE = 256  # side, pixels
_AHEAD = 4  # tiles of each thread that are encoded before they are written
_BUFFER = 2**24  # bytes of tiles that tifffile holds before it writes them; 256 MB by default
_DEFLATE_LEVEL = 1  # of 1 to 12: 2 takes 1.7 times as long and makes files 2 % smaller
MIN_OVERVIEW = 256  # pixels along the longer side: smaller images need no overview
_REDUCED, _MASK = 1, 4  # kinds of pages (NewSubfileType)
_BIGTIFF_FROM = 2**32 - 2**27
_GDAL_METADATA = 42112
_COPIED_TAGS = (ExifTags.Base.Make, ExifTags.Base.Model, ExifTags.Base.Artist, ExifTags.Base.Copyright)

# (code, type, count, value, only on the first page), as tifffile takes them.
ExtraTag = tuple[int, int, int, Any, bool]


def write_tiff(
    path: Path, spec: ImageSpec, strips: Iterable[Strip], extra_tags: Iterable[ExtraTag] = (), workers: int = 1
) -> list[Message]:
    """Write a TIFF file whose first page is the image and whose other pages are its overviews; threads encode tiles."""
    sizes = pyramid_sizes(spec.size, MIN_OVERVIEW)
    total = sum(w * h for w, h in sizes) * spec.samples_per_pixel * spec.dtype.itemsize
    joined = (with_alpha(*strip) if spec.transparent else strip[0] for strip in strips)
    mask: list[bytes] | None = [] if _has_mask(spec) else None
    with (
        tifffile.TiffWriter(path, bigtiff=total > _BIGTIFF_FROM) as tiff,
        ThreadPoolExecutor(workers) as pool,
    ):
        for size, passing in pyramid(sizes, joined, path.parent, transparent=spec.transparent):
            kind = 0 if size == spec.size else _REDUCED
            tags = [] if kind else [*copied_tags(spec.metadata), *_band_names(spec), *extra_tags]
            shown = passing if mask is None else _without_alpha(passing, mask)
            encoded = _encoded(tiles_of(shown), pool, workers)
            _write_page(tiff, spec, size, encoded, tags, kind)
            if mask is not None:
                _write_mask(tiff, size, mask, kind | _MASK)
                mask.clear()
    return put_in_order(path) if len(sizes) > 1 else []


def written_strips(path: Path) -> Iterator[Strip]:
    """The strips of a file that :func:`write_tiff` has made of grey images, or of others, with or without alpha."""
    with tifffile.TiffFile(path) as tiff:
        page, *others = tiff.pages
        assert isinstance(page, tifffile.TiffPage)
        mask = next((each for each in (other.aspage() for other in others) if each.subfiletype == _MASK), None)
        width, height = page.imagewidth, page.imagelength
        across, last_is_alpha = -(-width // TILE), any(page.extrasamples[-1:])
        for top in range(0, height, TILE):
            first = top // TILE * across
            rows = [
                np.concatenate([_tile(tiff, each, first + k) for k in range(across)], axis=1)[: height - top, :width]
                for each in (page, mask)
                if each is not None
            ]
            if mask is not None:
                yield rows[0], as_alpha(rows[1][..., 0] > 0)
            elif last_is_alpha:
                full = np.iinfo(rows[0].dtype).max if rows[0].dtype.kind == "u" else 1.0
                yield rows[0][..., :-1], np.rint(rows[0][..., -1] * (255.0 / full)).astype(np.uint8)
            else:
                yield rows[0], None


def _tile(tiff: "tifffile.TiffFile", page: "tifffile.TiffPage", index: int) -> NDArray[Any]:
    """A tile (h, w, C), completed."""
    tiff.filehandle.seek(page.dataoffsets[index])
    samples, _, _ = page.decode(tiff.filehandle.read(page.databytecounts[index]), index)
    assert samples is not None
    tile = samples[0]
    return np.pad(tile, [(0, TILE - tile.shape[0]), (0, TILE - tile.shape[1]), (0, 0)])


def _has_mask(spec: ImageSpec) -> bool:
    """Check whether transparency goes onto a page of its own."""
    return spec.transparent and spec.channels == 1


def _write_page(
    tiff: "tifffile.TiffWriter",
    spec: ImageSpec,
    size: tuple[int, int],
    tiles: Iterator[bytes],
    tags: list[ExtraTag],
    kind: int,
) -> None:
    """Write one page from all its tiles, as they stand in the file."""
    width, height = size
    transparent = spec.transparent and not _has_mask(spec)
    samples = spec.channels + transparent
    colour = 3 if spec.channels == 3 and not spec.metadata.planes else 1
    extra = ["unspecified"] * (spec.channels - colour) + ["unassalpha"] * transparent
    dpi = None if kind else spec.metadata.resolution
    tiff.write(
        tiles,
        shape=(height, width, samples) if samples > 1 else (height, width),
        dtype=spec.dtype,
        photometric="rgb" if colour == 3 else "minisblack",
        planarconfig="contig" if samples > 1 else None,
        extrasamples=extra or None,
        tile=(TILE, TILE),
        compression="zlib",
        predictor=has_predictor(spec.dtype),
        buffersize=_BUFFER,
        metadata=None,
        software="rdstitch",
        subfiletype=kind,
        resolution=dpi,
        resolutionunit="inch" if dpi else None,
        iccprofile=None if kind else spec.metadata.icc_profile or None,
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


def _band_names(spec: ImageSpec) -> Iterator[ExtraTag]:
    """Names of bands, as GDAL has them."""
    if spec.metadata.planes and len(spec.metadata.channel_names) == spec.channels:
        items = "".join(
            f'<Item name="DESCRIPTION" sample="{number}" role="description">{escape(name)}</Item>'
            for number, name in enumerate(spec.metadata.channel_names)
        )
        yield _GDAL_METADATA, 2, 0, f"<GDALMetadata>{items}</GDALMetadata>".encode(), True


def copied_tags(metadata: Metadata) -> Iterator[ExtraTag]:
    """XMP, and tags of the first image's EXIF that stay true of a mosaic."""
    if metadata.xmp:
        yield int(ExifTags.Base.XMLPacket), 1, len(metadata.xmp), metadata.xmp, True
    if metadata.exif:
        exif = Image.Exif()
        exif.load(metadata.exif)
        for tag in _COPIED_TAGS:
            text = exif.get(tag)
            # Cameras pad with zeros, of which GDAL warns.
            text = text.split("\0")[0].strip() if isinstance(text, str) else ""
            if text and text.isascii():
                yield int(tag), 2, 0, text, True


def tiles_of(strips: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """Tiles in the order of the file; those at the right and lower border completed."""
    for strip in strips:
        for y in range(0, strip.shape[0], TILE):
            for x in range(0, strip.shape[1], TILE):
                tile = strip[y : y + TILE, x : x + TILE]
                missing = [(0, TILE - n) for n in tile.shape[:2]] + [(0, 0)]
                yield np.pad(tile, missing) if any(b for _, b in missing) else tile


def has_predictor(dtype: np.dtype[Any]) -> bool:
    """Check whether differences of neighbours are stored; what is usual for floating point, few programs can read."""
    return dtype.kind == "u"


def _encoded(tiles: Iterable[NDArray[Any]], pool: ThreadPoolExecutor, workers: int) -> Iterator[bytes]:
    """Tiles as they stand in the file, in their order; threads are a few tiles ahead of whoever takes them.

    The compressor works without Python, beside what makes the next strips.
    """
    if workers == 1:
        yield from map(encoded_tile, tiles)
        return
    yield from in_order_ahead(pool, encoded_tile, tiles, _AHEAD * workers)


def encoded_tile(tile: NDArray[Any]) -> bytes:
    """A tile (h, w, C) as it stands in the file."""
    stored = tile.copy()
    if has_predictor(tile.dtype):
        stored[:, 1:] -= tile[:, :-1]
    return _deflated(stored)


def _deflated(stored: NDArray[Any]) -> bytes:
    """Compressed by libdeflate, which is fast, and makes the same bytes of the same samples every time."""
    return bytes(imagecodecs.deflate_encode(stored.tobytes(), _DEFLATE_LEVEL))
