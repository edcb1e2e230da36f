"""Writing an image: JPEG, PNG, TIFF, WebP or Deep Zoom by the suffix, whole or not at all, with profile and EXIF.

An image may come as an array or in strips from top to bottom; strips need only the memory of one of them, except for
WebP. The same image gives the same bytes either way.
"""

import io
import os
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from rdstitch.arrays import AnyArray, UInt8Array
from rdstitch.errors import ArgumentError
from rdstitch.io.deepzoom import write_deep_zoom
from rdstitch.io.fingerprint import Fingerprint, fingerprint
from rdstitch.io.formats import check_format
from rdstitch.io.metadata import Metadata
from rdstitch.io.samples import OPAQUE
from rdstitch.io.strips import STRIP_ROWS, ImageSpec, Strip, as_eight_bit, check_strips
from rdstitch.io.tiff import ExtraTag, write_tiff
from rdstitch.io.write_jpeg import jpeg_pieces
from rdstitch.io.write_ome import OME_SUFFIXES, write_ome_tiff, write_ome_zarr
from rdstitch.io.write_png import png_pieces
from rdstitch.results.messages import Message
from rdstitch.system.output_checks import check_folder, is_zarr, naming, tiles_folder
from rdstitch.system.outputs import Outputs

_TIFF = (".tif", ".tiff")
_JPEG = (".jpg", ".jpeg")
_WEBP_EFFORT = 4
_ROWS_AT_A_TIME = 4 * STRIP_ROWS


def write_image(
    path: str | Path,
    pixels: AnyArray,
    alpha: UInt8Array | None = None,
    metadata: Metadata | None = None,
    *,
    quality: int = 95,
    background: int = 0,
    overwrite: bool = True,
    outputs: Outputs | None = None,
) -> None:
    """Write an image (H, W) or (H, W, C) in RGB order; the format follows the suffix.

    Samples are uint8, uint16 or float32; the latter, and other than one or three channels, need TIFF. Alpha is 255
    where the image is opaque.

    The same input gives the same bytes. JPEG has no transparency and 8 bits: what is transparent becomes
    ``background``, 16 bits are rounded to 8.
    """
    if pixels.ndim not in (2, 3):
        raise ArgumentError(f"expected pixels of shape (H, W) or (H, W, C), not {pixels.shape}")
    samples = pixels[..., None] if pixels.ndim == 2 else pixels
    height, width, channels = samples.shape
    described = metadata or Metadata((width, height))
    spec = ImageSpec((width, height), channels, samples.dtype, alpha is not None, described, quality, background)
    pieces = (slice(top, top + _ROWS_AT_A_TIME) for top in range(0, height, _ROWS_AT_A_TIME))
    strips = ((samples[rows], None if alpha is None else alpha[rows]) for rows in pieces)
    with Outputs.or_own(outputs, overwrite) as staging:
        write_strips(path, spec, strips, outputs=staging)


class Written(NamedTuple):
    """An image that was written."""

    fingerprint: Fingerprint
    messages: list[Message]  # what the user should know of it


def write_strips(
    path: str | Path,
    spec: ImageSpec,
    strips: Iterable[Strip],
    extra_tags: Iterable[ExtraTag] = (),
    *,
    outputs: Outputs | None = None,
    workers: int = 1,
) -> Written:
    """Write an image that comes in strips; see :func:`write_image`.

    ``workers``: threads that may encode, beside what makes the next strips.
    """
    file = Path(path)
    check_format(file, spec)
    checked, tiles, messages = check_strips(spec, strips), None, list[Message]()
    spec = replace(spec, metadata=spec.metadata.with_samples(3 if file.suffix.lower() == ".webp" else spec.channels))
    with Outputs.or_own(outputs) as staging:
        check = partial(check_folder, overwrite=True)
        if file.suffix.lower() == ".dzi":
            folder = tiles_folder(Path(os.path.realpath(file)))
            check(folder)
            with staging.writing_pair(folder, file, check) as (tiles, staged):
                write_deep_zoom(staged, tiles, spec, checked)
        elif is_zarr(file):
            with staging.writing_folder(file, check) as staged:
                write_ome_zarr(staged, spec, checked)
        else:
            with staging.writing(file) as staged:
                messages = _write_file(staged, file.name.lower(), spec, checked, extra_tags, workers)
        with naming(file):
            return Written(fingerprint(staged, tiles), messages)


def _write_file(
    file: Path, name: str, spec: ImageSpec, strips: Iterable[Strip], extra_tags: Iterable[ExtraTag], workers: int
) -> list[Message]:
    """Write one file in the format that the end of a name stands for."""
    if name.endswith(OME_SUFFIXES):
        write_ome_tiff(file, spec, strips, extra_tags)
        return []
    suffix = Path(name).suffix
    if suffix in _TIFF:
        return write_tiff(file, spec, strips, extra_tags, workers)
    pieces: Iterable[bytes | memoryview]
    if suffix in _JPEG:
        pieces = jpeg_pieces(spec, strips, workers)
    elif suffix == ".png":
        pieces = png_pieces(spec, strips)
    else:
        pieces = [_webp(spec, strips)]
    with file.open("wb") as stream:
        stream.writelines(pieces)
    return []


def _webp(spec: ImageSpec, strips: Iterable[Strip]) -> bytes:
    """WebP file in memory: the encoder takes the image whole; see :data:`rdstitch.io.formats.FORMATS`."""
    width, height = spec.size
    samples = np.empty((height, width, 3 + spec.transparent), dtype=np.uint8)
    top = 0
    for strip in strips:
        rows = samples[top : top + len(strip[0])]
        # Grey goes to all three colours.
        rows[..., :3] = as_eight_bit(strip[0])
        if spec.transparent:
            rows[..., 3] = OPAQUE if strip[1] is None else strip[1]
        top += len(rows)
    stream = io.BytesIO()
    Image.fromarray(samples).save(
        stream,
        "WEBP",
        quality=spec.quality,
        method=_WEBP_EFFORT,
        exif=spec.metadata.exif,
        icc_profile=spec.metadata.icc_profile,
        xmp=spec.metadata.xmp,
    )
    return stream.getvalue()
