"""Writing an image: JPEG, PNG, TIFF, WebP or Deep Zoom by the suffix, whole or not at all, with profile and EXIF.

An image may come as an array or in strips from top to bottom; strips need only the memory of one of them, except for
WebP. The same image gives the same bytes either way.
"""

import io
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rdstitch.errors import ArgumentError, LimitError, OutputError
from rdstitch.io.deepzoom import write_deep_zoom
from rdstitch.io.encoding import STRIP_ROWS, ImageSpec, Strip, as_eight_bit, check_strips, jpeg_pieces, png_pieces
from rdstitch.io.metadata import Metadata
from rdstitch.io.ome_zarr import check_zarr, write_ome_zarr
from rdstitch.io.samples import OPAQUE
from rdstitch.io.tiff import OME_SUFFIXES, ExtraTag, write_ome_tiff, write_tiff
from rdstitch.system.outputs import (
    WRITABLE_SUFFIXES,
    Fingerprint,
    Outputs,
    check_folder,
    fingerprint,
    is_zarr,
    naming,
    tiles_folder,
)

# Width and height that the formats (or their one encoder) can hold.
SIDE_LIMITS = {".jpg": 65500, ".jpeg": 65500, ".webp": 16383, ".png": 1_000_000}
_TIFF = (".tif", ".tiff")
_JPEG = (".jpg", ".jpeg")
_WEBP_EFFORT = 4
# The samples, Pillow's copy of them, the encoder's own, and the output; measured: 13 to 16 with 4 and 16 megapixels.
_WEBP_BYTES_PER_PIXEL = 20
_ROWS_AT_A_TIME = 4 * STRIP_ROWS


def write_image(
    path: str | Path,
    pixels: NDArray[Any],
    alpha: NDArray[np.uint8] | None = None,
    metadata: Metadata | None = None,
    *,
    quality: int = 95,
    background: int = 0,
    overwrite: bool = True,
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
    with Outputs(overwrite) as outputs:
        write_strips(path, spec, strips, outputs=outputs)


def write_strips(
    path: str | Path,
    spec: ImageSpec,
    strips: Iterable[Strip],
    extra_tags: Iterable[ExtraTag] = (),
    *,
    outputs: Outputs | None = None,
) -> Fingerprint:
    """Write an image that comes in strips; see :func:`write_image`. Gives size and digest of what was written."""
    if outputs is None:
        with Outputs(overwrite=True) as alone:
            return write_strips(path, spec, strips, extra_tags, outputs=alone)
    file = Path(path)
    check_format(file, spec)
    suffix = file.suffix.lower()
    checked = check_strips(spec, strips)
    tiles = None
    if suffix == ".dzi":
        folder = tiles_folder(Path(os.path.realpath(file)))
        check_folder(folder, overwrite=True)
        with outputs.writing(folder, is_folder=True) as tiles, outputs.writing(file) as staged:
            write_deep_zoom(staged, tiles, spec, checked)
    elif is_zarr(file):
        with outputs.writing(file, is_folder=True) as staged:
            write_ome_zarr(staged, spec, checked)
    else:
        with outputs.writing(file) as staged:
            if file.name.lower().endswith(OME_SUFFIXES):
                write_ome_tiff(staged, spec, checked, extra_tags)
            else:
                _write_file(staged, suffix, spec, checked, extra_tags)
    with naming(file):
        return fingerprint(staged, tiles)


def _write_file(
    file: Path, suffix: str, spec: ImageSpec, strips: Iterable[Strip], extra_tags: Iterable[ExtraTag]
) -> None:
    """Write one file in the format of a suffix."""
    if suffix in _TIFF:
        write_tiff(file, spec, strips, extra_tags)
        return
    pieces: Iterable[bytes | memoryview]
    if suffix in _JPEG:
        pieces = jpeg_pieces(spec, strips)
    elif suffix == ".png":
        pieces = png_pieces(spec, strips)
    else:
        pieces = [_webp(spec, strips)]
    with file.open("wb") as stream:
        stream.writelines(pieces)


def check_format(path: str | Path, spec: ImageSpec) -> None:
    """Find out before long work whether the format of ``path`` can hold an image."""
    suffix = Path(path).suffix.lower()
    if suffix not in WRITABLE_SUFFIXES:
        raise OutputError(f"{path}: unknown file type '{suffix}'; use one of {' '.join(WRITABLE_SUFFIXES)}")
    if suffix == ".zarr":
        check_zarr(Path(path))
    if suffix in (*_TIFF, ".zarr"):
        return
    if spec.channels not in (1, 3):
        raise OutputError(f"{path}: {spec.channels} channels do not fit into {suffix[1:]}; write a .tif")
    if spec.dtype == np.float32:
        raise OutputError(f"{path}: floating-point samples do not fit into {suffix[1:]}; write a .tif")
    check_size(path, spec.size)


def check_size(path: str | Path, size: tuple[int, int]) -> None:
    """Refuse an image of ``size`` (width, height) that the format of ``path`` cannot hold."""
    suffix = Path(path).suffix.lower()
    limit = SIDE_LIMITS.get(suffix)
    if limit is not None and max(size) > limit:
        raise LimitError(
            f"{path}: {size[0]} x {size[1]} pixels is more than {suffix[1:]} can hold ({limit} pixels a side); "
            "write a .tif, or use a smaller --scale"
        )


def check_memory(path: str | Path, size: tuple[int, int], max_memory: int | None) -> None:
    """Refuse an image that the format of ``path`` needs whole in memory, where that is limited."""
    need = size[0] * size[1] * _WEBP_BYTES_PER_PIXEL
    if Path(path).suffix.lower() == ".webp" and max_memory is not None and need > max_memory:
        raise LimitError(
            f"{path}: {size[0]} x {size[1]} pixels of WebP need {need / 2**20:.0f} MB, and --max-memory allows "
            f"{max_memory / 2**20:.0f} MB; write a .tif, .png or .jpg, which are written in strips"
        )


def _webp(spec: ImageSpec, strips: Iterable[Strip]) -> bytes:
    """WebP file in memory: the encoder takes the image whole; see :data:`_WEBP_BYTES_PER_PIXEL`."""
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
