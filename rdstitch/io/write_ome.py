"""Images as microscopes' programs read them, with a pyramid: OME-TIFF and OME-Zarr, from strips."""

import hashlib
import tempfile
import uuid
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rdstitch.arrays import AnyArray
from rdstitch.errors import OutputError
from rdstitch.io.pyramid import pyramid, pyramid_sizes
from rdstitch.io.strips import STRIP_ROWS, ImageSpec, Strip, placed_rows, zero_uncovered
from rdstitch.io.tiff import MIN_OVERVIEW, ExtraTag, copied_tags, tiled, tiles_of
from rdstitch.system.late_imports import tifffile

OME_SUFFIXES = (".ome.tif", ".ome.tiff")
_SMALLEST = 512  # pixels of the longer side of the last level, at most
_COLOURS = ("FFFFFF", "FF00FF", "00FF00", "00FFFF", "FFFF00", "FF8000")
_RGB = ("FF0000", "00FF00", "0000FF")


def write_ome_tiff(path: Path, spec: ImageSpec, strips: Iterable[Strip], extra_tags: Iterable[ExtraTag] = ()) -> None:
    """Write an OME-TIFF file with a pyramid; what no image covers is 0.

    Channels become pages; those of a colour image stay together.
    """
    sizes = pyramid_sizes(spec.size, MIN_OVERVIEW)
    separate = spec.metadata.planes or spec.channels != 3
    passing_levels = pyramid(sizes, zero_uncovered(strips), path.parent, transparent=False)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        levels: list[AnyArray] = []
        for number, ((width, height), passing) in enumerate(passing_levels):
            level = np.memmap(Path(folder) / str(number), spec.dtype, "w+", shape=(height, width, spec.channels))
            for at, rows in placed_rows(passing):
                level[at] = rows
            levels.append(level)
        total = sum(level.nbytes for level in levels)
        with tifffile.TiffWriter(path, ome=True, bigtiff=total > 2**31) as tiff:
            for number, pixels in enumerate(levels):
                height, width, channels = pixels.shape
                parts = [pixels[..., k : k + 1] for k in range(channels)] if separate else [pixels]
                tops = range(0, height, STRIP_ROWS)
                shown = (np.ascontiguousarray(part[top : top + STRIP_ROWS]) for part in parts for top in tops)
                tiff.write(
                    tiles_of(shown),
                    shape=(channels, height, width) if separate else (height, width, channels),
                    **tiled(spec.dtype),
                    maxworkers=1,
                    photometric="minisblack" if separate else "rgb",
                    planarconfig=None if separate else "contig",
                    subifds=None if number else len(levels) - 1,
                    subfiletype=1 if number else 0,
                    metadata=None if number else _ome_metadata(spec, pixels, separate=separate),
                    iccprofile=None if number else spec.metadata.icc_profile or None,
                    extratags=[] if number else [*copied_tags(spec.metadata), *extra_tags],
                )


def _ome_metadata(spec: ImageSpec, pixels: AnyArray, *, separate: bool) -> dict[str, Any]:
    """What OME-XML says of the image, whose channels are pages where they are ``separate``."""
    samples = hashlib.sha256(pixels.data).hexdigest()
    identity = uuid.uuid5(uuid.NAMESPACE_OID, f"rdstitch {spec.size} {spec.channels} {spec.dtype} {samples}")
    content: dict[str, Any] = {"axes": "CYX" if separate else "YXS", "UUID": f"urn:uuid:{identity}"}
    if spec.metadata.pixel_size is not None:
        for axis in "XY":
            content |= {f"PhysicalSize{axis}": spec.metadata.pixel_size, f"PhysicalSize{axis}Unit": "µm"}
    if separate and len(spec.metadata.channel_names) == spec.channels:
        content["Channel"] = {"Name": list(spec.metadata.channel_names)}
    return content


def check_zarr(path: Path) -> None:
    """Refuse an OME-Zarr image before long work where the package that writes it is missing."""
    try:
        import zarr  # noqa: F401
    except ImportError:
        raise OutputError(f"{path}: writing OME-Zarr needs zarr: pip install zarr") from None


def write_ome_zarr(folder: Path, spec: ImageSpec, strips: Iterable[Strip]) -> None:
    """Write OME-Zarr (NGFF 0.4) into a folder, chunk by chunk; channels are planes, what no image covers is 0."""
    import zarr

    sizes = pyramid_sizes(spec.size, _SMALLEST)
    group = zarr.open_group(folder, mode="w", zarr_format=2)
    passing_levels = pyramid(sizes, zero_uncovered(strips), folder.parent, transparent=False)
    for number, ((width, height), passing) in enumerate(passing_levels):
        level = group.create_array(
            str(number),
            shape=(spec.channels, height, width),
            chunks=(1, min(STRIP_ROWS, height), min(STRIP_ROWS, width)),
            dtype=spec.dtype,
            chunk_key_encoding={"name": "v2", "separator": "/"},
        )
        for at, rows in placed_rows(passing):
            level[:, at] = np.moveaxis(rows, -1, 0)
    group.attrs.update(_attributes(spec, len(sizes)))


def _attributes(spec: ImageSpec, levels: int) -> dict[str, Any]:
    """What NGFF says of the axes, the size of a pixel and the channels."""
    size = spec.metadata.pixel_size
    unit = {} if size is None else {"unit": "micrometer"}
    axes = [{"name": "c", "type": "channel"}, *({"name": axis, "type": "space", **unit} for axis in "yx")]
    datasets = []
    for number in range(levels):
        pixel, shift = (size or 1.0) * 2**number, (size or 1.0) * (2**number - 1) / 2.0
        steps = [{"type": "scale", "scale": [1.0, pixel, pixel]}]
        steps += [{"type": "translation", "translation": [0.0, shift, shift]}] if number else []
        datasets.append({"path": str(number), "coordinateTransformations": steps})
    colours = _RGB if spec.channels == 3 and not spec.metadata.planes else _COLOURS
    names = spec.metadata.channel_names or [str(k) for k in range(spec.channels)]
    top = 1.0 if spec.dtype.kind == "f" else float(np.iinfo(spec.dtype).max)
    window = {"min": 0.0, "max": top, "start": 0.0, "end": top}
    return {
        "multiscales": [{"version": "0.4", "name": "image", "axes": axes, "datasets": datasets, "type": "mean"}],
        "omero": {
            "version": "0.4",
            "channels": [
                {"label": name, "color": colours[k % len(colours)], "active": True, "window": window}
                for k, name in zip(range(spec.channels), names, strict=False)
            ],
        },
    }
