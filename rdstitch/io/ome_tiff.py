"""OME-TIFF with a pyramid, as microscopes' programs read it."""

import hashlib
import tempfile
import uuid
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rdstitch.arrays import AnyArray
from rdstitch.io.pyramid import pyramid, pyramid_sizes
from rdstitch.io.strips import STRIP_ROWS, ImageSpec, Strip, placed_rows, zero_uncovered
from rdstitch.io.tiff import MIN_OVERVIEW, ExtraTag, copied_tags, tiled, tiles_of
from rdstitch.system.late_imports import tifffile

OME_SUFFIXES = (".ome.tif", ".ome.tiff")


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
