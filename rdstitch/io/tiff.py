"""TIFF from strips: compressed, BigTIFF where needed, with overviews of half the size again and again; OME-TIFF.

Grey samples with alpha are something that OpenCV (4.11 to 5.0) reads as stripes or reduces to 8 bits, and that Pillow
does not read where they are deeper; their transparency is a mask on a page of its own, as GDAL writes it, and every
program reads the first page. Where there are overviews, the file is in the order of a Cloud Optimized GeoTIFF: what
describes the pages comes first, then the pixels, smallest overview first, so that a reader of a part fetches little but
that part. While an image is being made nobody knows where its parts will lie: compressed tiles are copied afterwards.
"""

import hashlib
import struct
import tempfile
import uuid
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from rdstitch.io.encoding import STRIP_ROWS, ImageSpec, Strip, pyramid, pyramid_sizes, with_alpha
from rdstitch.io.metadata import Metadata
from rdstitch.system.late_imports import imagecodecs, tifffile

OME_SUFFIXES = (".ome.tif", ".ome.tiff")
_TILE = 256
_REDUCED, _MASK = 1, 4  # kinds of pages (NewSubfileType)
# Smaller images need no overview.
_MIN_OVERVIEW = 256
_BUFFER = 2**24
_LEVEL = 1  # of 1 to 12: 2 takes 1.7 times as long and makes files 2 % smaller
_BIGTIFF_FROM = 2**32 - 2**27
_XMP, _GDAL_METADATA = 700, 42112
_OFFSETS = (324, 273)  # of tiles and strips
_ENTRY = "HH"  # of a directory, before count and value
_DPI = 150  # offsets of cropped files are counted in inches; any resolution will do
_X_POSITION, _Y_POSITION, _FULL_WIDTH, _FULL_LENGTH = 286, 287, 33300, 33301
_RATIONAL, _LONG = 5, 4
_COPIED_TAGS = (ExifTags.Base.Make, ExifTags.Base.Model, ExifTags.Base.Artist, ExifTags.Base.Copyright)
# (code, type, count, value, only on the first page), as tifffile takes them.
ExtraTag = tuple[int, int, int, Any, bool]


def write_tiff(path: Path, spec: ImageSpec, strips: Iterable[Strip], extra_tags: Iterable[ExtraTag] = ()) -> None:
    """Write a TIFF file whose first page is the image and whose other pages are its overviews."""
    sizes = pyramid_sizes(spec.size, _MIN_OVERVIEW)
    total = sum(w * h for w, h in sizes) * spec.samples_per_pixel * spec.dtype.itemsize
    joined = (with_alpha(*strip) if spec.transparent else strip[0] for strip in strips)
    mask: list[bytes] | None = [] if _has_mask(spec) else None
    with tifffile.TiffWriter(path, bigtiff=total > _BIGTIFF_FROM) as tiff:
        for size, passing in pyramid(sizes, joined, path.parent, transparent=spec.transparent):
            kind = 0 if size == spec.size else _REDUCED
            tags = [] if kind else [*_copied_tags(spec.metadata), *_band_names(spec), *extra_tags]
            shown = passing if mask is None else _without_alpha(passing, mask)
            _write_page(tiff, spec, size, shown, tags, kind)
            if mask is not None:
                _write_mask(tiff, size, mask, kind | _MASK)
                mask.clear()
    if len(sizes) > 1:
        _put_in_order(path)


def written_strips(path: Path) -> Iterator[Strip]:
    """The strips of a file that :func:`write_tiff` has made of grey images, or of others, with or without alpha."""
    with tifffile.TiffFile(path) as tiff:
        page, *others = tiff.pages
        assert isinstance(page, tifffile.TiffPage)
        mask = next((each for each in (other.aspage() for other in others) if each.subfiletype == _MASK), None)
        width, height = page.imagewidth, page.imagelength
        across, last_is_alpha = -(-width // _TILE), any(page.extrasamples[-1:])
        for top in range(0, height, _TILE):
            first = top // _TILE * across
            rows = [
                np.concatenate([_tile(tiff, each, first + k) for k in range(across)], axis=1)[: height - top, :width]
                for each in (page, mask)
                if each is not None
            ]
            if mask is not None:
                yield rows[0], np.where(rows[1][..., 0] > 0, 255, 0).astype(np.uint8)
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
    return np.pad(tile, [(0, _TILE - tile.shape[0]), (0, _TILE - tile.shape[1]), (0, 0)])


def _has_mask(spec: ImageSpec) -> bool:
    """Check whether transparency goes onto a page of its own."""
    return spec.transparent and spec.channels == 1


def _write_page(
    tiff: "tifffile.TiffWriter",
    spec: ImageSpec,
    size: tuple[int, int],
    strips: Iterable[NDArray[Any]],
    tags: list[ExtraTag],
    kind: int,
) -> None:
    """Write one page from strips that hold all its samples."""
    width, height = size
    transparent = spec.transparent and not _has_mask(spec)
    samples = spec.channels + transparent
    colour = 3 if spec.channels == 3 and not spec.metadata.planes else 1
    extra = ["unspecified"] * (spec.channels - colour) + ["unassalpha"] * transparent
    dpi = None if kind else spec.metadata.dpi
    tiff.write(
        (_encoded_tile(tile) for tile in _tiles_of(strips)),
        shape=(height, width, samples) if samples > 1 else (height, width),
        dtype=spec.dtype,
        photometric="rgb" if colour == 3 else "minisblack",
        planarconfig="contig" if samples > 1 else None,
        extrasamples=extra or None,
        tile=(_TILE, _TILE),
        compression="zlib",
        predictor=_has_predictor(spec.dtype),
        # Tiles that tifffile holds before it writes them; 256 MB by default.
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
        bits = (np.packbits(tile[..., 0], axis=1) for tile in _tiles_of([strip[..., -1:] > 0]))
        mask += [_deflated(tile) for tile in bits]
        yield strip[..., :-1]


def _write_mask(tiff: "tifffile.TiffWriter", size: tuple[int, int], tiles: list[bytes], kind: int) -> None:
    """Write the page that says where the page before it has an image."""
    tiff.write(
        iter(tiles),
        shape=size[::-1],
        dtype=np.bool_,
        photometric="mask",
        tile=(_TILE, _TILE),
        compression="zlib",
        metadata=None,
        software="rdstitch",
        subfiletype=kind,
    )


def _tiles_of(strips: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """Tiles in the order of the file; those at the right and lower border completed."""
    for strip in strips:
        for y in range(0, strip.shape[0], _TILE):
            for x in range(0, strip.shape[1], _TILE):
                tile = strip[y : y + _TILE, x : x + _TILE]
                missing = [(0, _TILE - n) for n in tile.shape[:2]] + [(0, 0)]
                yield np.pad(tile, missing) if any(b for _, b in missing) else tile


def _has_predictor(dtype: np.dtype[Any]) -> bool:
    """Check whether differences of neighbours are stored; what is usual for floating point, few programs can read."""
    return dtype.kind == "u"


def _encoded_tile(tile: NDArray[Any]) -> bytes:
    """A tile (h, w, C) as it stands in the file."""
    stored = tile.copy()
    if _has_predictor(tile.dtype):
        stored[:, 1:] -= tile[:, :-1]
    return _deflated(stored)


def _deflated(stored: NDArray[Any]) -> bytes:
    """Compressed by libdeflate, which is fast, and makes the same bytes of the same samples every time."""
    return bytes(imagecodecs.deflate_encode(stored.tobytes(), _LEVEL))


def _band_names(spec: ImageSpec) -> Iterator[ExtraTag]:
    """Names of bands, as GDAL has them."""
    if spec.metadata.planes and len(spec.metadata.channel_names) == spec.channels:
        items = "".join(
            f'<Item name="DESCRIPTION" sample="{number}" role="description">{escape(name)}</Item>'
            for number, name in enumerate(spec.metadata.channel_names)
        )
        yield _GDAL_METADATA, 2, 0, f"<GDALMetadata>{items}</GDALMetadata>".encode(), True


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


class _Page(NamedTuple):
    """A directory: type, count and bytes of each value by its code; and where its tiles lie, and how long they are."""

    values: dict[int, tuple[int, int, bytes]]
    offsets: tuple[int, ...]
    lengths: tuple[int, ...]

    def bytes_at(self, room: int) -> int:
        """Bytes, where values of so many fit into their entries."""
        entries = len(self.values) * (struct.calcsize(f"={_ENTRY}") + 2 * room)
        longer = sum(_even(len(data)) for _, _, data in self.values.values() if len(data) > room)
        return _head(room) + entries + room + longer


def _put_in_order(path: Path) -> None:
    """Rewrite a TIFF file: header, directories in their order, tiles of the last page, …, tiles of the first.

    Needs room for a copy beside it.
    """
    ordered = path.with_name(f"{path.name}.ordered")
    with tifffile.TiffFile(path) as tiff, path.open("rb") as source, ordered.open("wb") as target:
        order, room = tiff.byteorder, 8 if tiff.is_bigtiff else 4
        pages = [_page(source, page) for page in tiff.pages]
        place = 2 * room
        target.write(_bytes_at(source, 0, room) + _packed(order, room, [place]))
        *places, place = accumulate((page.bytes_at(room) for page in pages), initial=place)
        tiles = []
        for page in reversed(pages):
            *starts, place = accumulate(map(_even, page.lengths), initial=place)
            tiles.append(starts)
        for page, at, following, offsets in zip(pages, places, [*places[1:], 0], reversed(tiles), strict=True):
            target.write(_directory(page, order, room, at, following, offsets))
        for page in reversed(pages):
            for offset, length in zip(page.offsets, page.lengths, strict=True):
                target.write(_bytes_at(source, offset, length).ljust(_even(length), b"\0"))
    ordered.replace(path)


def _page(source: BinaryIO, page: "tifffile.TiffPage | tifffile.TiffFrame") -> _Page:
    assert isinstance(page, tifffile.TiffPage)
    values = {
        int(tag.code): (int(tag.dtype), int(tag.count), _bytes_at(source, tag.valueoffset, tag.valuebytecount))
        for tag in page.tags
    }
    return _Page(values, tuple(page.dataoffsets), tuple(page.databytecounts))


def _directory(page: _Page, order: str, room: int, place: int, following: int, offsets: list[int]) -> bytes:
    """A directory at a place, with where the next one and its own tiles will lie."""
    entries, longer = [], b""
    place += page.bytes_at(room)
    place -= sum(_even(len(data)) for _, _, data in page.values.values() if len(data) > room)
    for code, (kind, count, data) in page.values.items():
        if code in _OFFSETS:
            data = _packed(order, len(data) // count, offsets)
        if len(data) > room:
            shown = _packed(order, room, [place + len(longer)])
            longer += data.ljust(_even(len(data)), b"\0")
        else:
            shown = data.ljust(room, b"\0")
        entries.append(struct.pack(f"{order}{_ENTRY}", code, kind) + _packed(order, room, [count]) + shown)
    head = _packed(order, _head(room), [len(entries)])
    return head + b"".join(entries) + _packed(order, room, [following]) + longer


def _head(room: int) -> int:
    """Bytes of the number of entries."""
    return 8 if room == 8 else 2


def _packed(order: str, size: int, numbers: list[int]) -> bytes:
    """Whole numbers of so many bytes each."""
    return struct.pack(f"{order}{len(numbers)}{ {2: 'H', 4: 'I', 8: 'Q'}[size] }", *numbers)


def _bytes_at(source: BinaryIO, offset: int, length: int) -> bytes:
    source.seek(offset)
    return source.read(length)


def _even(length: int) -> int:
    return length + length % 2


def write_ome_tiff(path: Path, spec: ImageSpec, strips: Iterable[Strip], extra_tags: Iterable[ExtraTag] = ()) -> None:
    """Write an OME-TIFF file with a pyramid; what no image covers is 0.

    Channels become pages; those of a colour image stay together.
    """
    sizes = pyramid_sizes(spec.size, _MIN_OVERVIEW)
    apart = spec.metadata.planes or spec.channels != 3
    shown = (pixels if alpha is None else np.where(alpha[..., None] > 0, pixels, 0) for pixels, alpha in strips)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        levels: list[NDArray[Any]] = []
        for number, ((width, height), passing) in enumerate(pyramid(sizes, shown, path.parent, transparent=False)):
            level = np.memmap(Path(folder) / str(number), spec.dtype, "w+", shape=(height, width, spec.channels))
            top = 0
            for rows in passing:
                level[top : top + len(rows)] = rows
                top += len(rows)
            levels.append(level)
        total = sum(level.nbytes for level in levels)
        with tifffile.TiffWriter(path, ome=True, bigtiff=total > 2**31) as tiff:
            for number, pixels in enumerate(levels):
                height, width, channels = pixels.shape
                parts = [pixels[..., k : k + 1] for k in range(channels)] if apart else [pixels]
                tops = range(0, height, STRIP_ROWS)
                shown = (np.ascontiguousarray(part[top : top + STRIP_ROWS]) for part in parts for top in tops)
                tiff.write(
                    (_encoded_tile(tile) for tile in _tiles_of(shown)),
                    shape=(channels, height, width) if apart else (height, width, channels),
                    dtype=spec.dtype,
                    photometric="minisblack" if apart else "rgb",
                    planarconfig=None if apart else "contig",
                    tile=(_TILE, _TILE),
                    compression="zlib",
                    predictor=_has_predictor(spec.dtype),
                    subifds=None if number else len(levels) - 1,
                    subfiletype=1 if number else 0,
                    metadata=None if number else _ome_metadata(spec, pixels, apart=apart),
                    software="rdstitch",
                    iccprofile=None if number else spec.metadata.icc_profile or None,
                    extratags=[] if number else [*_copied_tags(spec.metadata), *extra_tags],
                )


def _ome_metadata(spec: ImageSpec, pixels: NDArray[Any], *, apart: bool) -> dict[str, Any]:
    """What OME-XML says of the image, whose channels are pages where they are ``apart``."""
    samples = hashlib.sha256(pixels.data).hexdigest()
    identity = uuid.uuid5(uuid.NAMESPACE_OID, f"rdstitch {spec.size} {spec.channels} {spec.dtype} {samples}")
    content: dict[str, Any] = {"axes": "CYX" if apart else "YXS", "UUID": f"urn:uuid:{identity}"}
    if spec.metadata.pixel_size is not None:
        for axis in "XY":
            content |= {f"PhysicalSize{axis}": spec.metadata.pixel_size, f"PhysicalSize{axis}Unit": "µm"}
    if apart and len(spec.metadata.channel_names) == spec.channels:
        content["Channel"] = {"Name": list(spec.metadata.channel_names)}
    return content


def write_cropped_tiff(
    path: Path,
    pixels: NDArray[Any],
    alpha: NDArray[np.uint8] | None,
    offset: tuple[int, int],
    size: tuple[int, int],
    extra_tags: Sequence[ExtraTag] = (),
) -> None:
    """Write a part (h, w) or (h, w, C) of a canvas of ``size``, its first pixel at ``offset``; alpha is 0 or 255.

    As Hugin's nona writes it and enblend reads it.
    """
    samples = pixels[..., None] if pixels.ndim == 2 else pixels
    colours = 3 if samples.shape[2] == 3 else 1
    extra = ["unspecified"] * (samples.shape[2] - colours)
    if alpha is not None:
        samples, extra = with_alpha(samples, alpha), [*extra, "unassalpha"]
    positions = [
        (tag, _RATIONAL, 1, (at, _DPI), True) for tag, at in zip((_X_POSITION, _Y_POSITION), offset, strict=True)
    ]
    whole = [(tag, _LONG, 1, side, True) for tag, side in zip((_FULL_WIDTH, _FULL_LENGTH), size, strict=True)]
    tifffile.imwrite(
        path,
        samples if extra else samples[..., 0] if colours == 1 else samples,
        photometric="rgb" if colours == 3 else "minisblack",
        planarconfig="contig",
        extrasamples=extra or None,
        compression="zlib",
        predictor=samples.dtype.kind == "u",
        resolution=(_DPI, _DPI),
        resolutionunit="inch",
        extratags=[*positions, *whole, *extra_tags],
        metadata=None,
        software=False,
    )
