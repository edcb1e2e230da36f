"""TIFF from strips: compressed, BigTIFF where needed, with overviews of half the size again and again.

Grey samples with alpha are something that OpenCV (4.11 to 5.0) reads as stripes or reduces to 8 bits, and that Pillow
does not read where they are deeper; their transparency is a mask on a page of its own, as GDAL writes it, and every
program reads the first page. The file is in the order of a Cloud Optimized GeoTIFF (:mod:`rdstitch.io.tiff_order`).
"""

from collections.abc import Iterable, Iterator
from html import escape
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from rdstitch.arrays import AnyArray
from rdstitch.io.metadata import Metadata
from rdstitch.io.pyramid import pyramid, pyramid_sizes
from rdstitch.io.samples import as_alpha
from rdstitch.io.strips import ImageSpec, Strip, with_alpha
from rdstitch.io.tiff_order import put_in_order
from rdstitch.results.messages import Message
from rdstitch.system.late_imports import imagecodecs, tifffile

TILE = 256  # side, pixels
_BUFFER = 2**24  # bytes of tiles that tifffile holds at a time; 256 MB by default
_DEFLATE_LEVEL = 1  # of 1 to 12: 2 takes 1.7 times as long and makes files 2 % smaller
MIN_OVERVIEW = 256  # pixels along the longer side: smaller images need no overview
_REDUCED, _MASK = 1, 4  # kinds of pages (NewSubfileType)
_BIGTIFF_FROM = 2**32 - 2**27
_GDAL_METADATA = 42112
_COPIED_TAGS = tuple(getattr(ExifTags.Base, name) for name in ("Make", "Model", "DateTime", "Artist", "Copyright"))

# (code, type, count, value, only on the first page), as tifffile takes them.
ExtraTag = tuple[int, int, int, Any, bool]


def write_tiff(
    path: Path, spec: ImageSpec, strips: Iterable[Strip], extra_tags: Iterable[ExtraTag] = (), workers: int = 1
) -> list[Message]:
    """Write a TIFF file whose first page is the image and whose other pages are its overviews; threads encode tiles."""
    sizes = pyramid_sizes(spec.size, MIN_OVERVIEW)
    total = sum(w * h for w, h in sizes) * spec.samples_per_pixel * spec.dtype.itemsize
    joined = (with_alpha(*strip) if spec.transparent else strip[0] for strip in strips)
    mask: list[bytes] | None = [] if spec.transparent and spec.channels == 1 else None
    with tifffile.TiffWriter(path, bigtiff=total > _BIGTIFF_FROM) as tiff:
        for size, passing in pyramid(sizes, joined, path.parent, transparent=spec.transparent):
            kind = 0 if size == spec.size else _REDUCED
            tags = [] if kind else [*copied_tags(spec.metadata), *_band_names(spec), *extra_tags]
            shown = passing if mask is None else _without_alpha(passing, mask)
            tiff.write(
                tiles_of(shown),
                **_samples(spec, size, alpha=spec.transparent and mask is None),
                **tiled(spec.dtype),
                buffersize=_BUFFER,
                maxworkers=workers,
                metadata=None,
                subfiletype=kind,
                resolution=None if kind else spec.metadata.resolution,
                resolutionunit=None if kind or spec.metadata.resolution is None else "inch",
                iccprofile=None if kind else spec.metadata.icc_profile or None,
                extratags=tags,
            )
            if mask is not None:
                how = tiled(np.dtype(np.bool_))
                tiff.write(
                    iter(mask), shape=size[::-1], photometric="mask", **how, metadata=None, subfiletype=kind | _MASK
                )
                mask.clear()
    return put_in_order(path, spec.metadata.exif)


def written_strips(path: Path) -> Iterator[Strip]:
    """The strips of a file that :func:`write_tiff` has made of grey images, or of others, with or without alpha."""
    with tifffile.TiffFile(path) as tiff:
        page, *others = tiff.pages
        assert isinstance(page, tifffile.TiffPage)
        mask = next((each for each in (other.aspage() for other in others) if each.subfiletype == _MASK), None)
        width, height = page.imagewidth, page.imagelength
        across, last_is_alpha = -(-width // TILE), any(page.extrasamples[-1:])
        streams = [
            (tile for tile, _, _ in each.segments(maxworkers=1, buffersize=_BUFFER))
            for each in (page, mask)
            if each is not None
        ]
        for top in range(0, height, TILE):
            rows = [np.concatenate([*islice(tiles, across)], axis=2)[0, : height - top, :width] for tiles in streams]
            if mask is not None:
                yield rows[0], as_alpha(rows[1][..., 0] > 0)
            elif last_is_alpha:
                full = np.iinfo(rows[0].dtype).max if rows[0].dtype.kind == "u" else 1.0
                yield rows[0][..., :-1], np.rint(rows[0][..., -1] * (255.0 / full)).astype(np.uint8)
            else:
                yield rows[0], None


def _samples(spec: ImageSpec, size: tuple[int, int], *, alpha: bool) -> dict[str, Any]:
    """What tifffile is told of the samples of a page, with alpha or without."""
    samples, colours = spec.channels + alpha, 3 if spec.channels == 3 and not spec.metadata.planes else 1
    return {
        "shape": (*size[::-1], samples) if samples > 1 else size[::-1],
        "photometric": "rgb" if colours == 3 else "minisblack",
        "planarconfig": "contig" if samples > 1 else None,
        "extrasamples": ["unspecified"] * (spec.channels - colours) + ["unassalpha"] * alpha or None,
    }


def tiled(dtype: np.dtype[Any]) -> dict[str, Any]:
    """What tifffile is told of every page: its tiles are packed by libdeflate, always to the same bytes.

    Differences of neighbours are stored of whole numbers; of floating point few programs can read them.
    """
    packing = {"compression": "zlib", "compressionargs": {"level": _DEFLATE_LEVEL}, "predictor": dtype.kind == "u"}
    return {"dtype": dtype, "tile": (TILE, TILE), **packing, "software": "rdstitch"}


def _without_alpha(strips: Iterable[AnyArray], mask: list[bytes]) -> Iterator[AnyArray]:
    """The strips without alpha; tiles of where that is not 0, one bit a pixel, are added to ``mask`` as stored."""
    for strip in strips:
        bits = (np.packbits(tile[..., 0], axis=1) for tile in tiles_of([strip[..., -1:] > 0]))
        mask += [bytes(imagecodecs.deflate_encode(tile.tobytes(), _DEFLATE_LEVEL)) for tile in bits]
        yield strip[..., :-1]


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
            if isinstance(text, str) and (text := text.split("\0")[0].strip()):
                yield int(tag), 2, 0, text.encode("latin-1"), True  # the bytes that they were read from


def tiles_of(strips: Iterable[AnyArray]) -> Iterator[AnyArray]:
    """Tiles in the order of the file; those at the right and lower border completed."""
    for strip in strips:
        for y in range(0, strip.shape[0], TILE):
            for x in range(0, strip.shape[1], TILE):
                tile = strip[y : y + TILE, x : x + TILE]
                missing = [(0, TILE - n) for n in tile.shape[:2]] + [(0, 0)]
                yield np.pad(tile, missing) if any(b for _, b in missing) else tile
