"""OME-Zarr (NGFF 0.4) from strips, chunk by chunk, for napari, QuPath, Fiji and notebooks.

An image's channels are planes, and each level is half as large as the one before; memory is that of a few strips.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rdstitch.errors import OutputError
from rdstitch.io.pyramid import pyramid, pyramid_sizes
from rdstitch.io.strips import STRIP_ROWS, ImageSpec, Strip, placed_rows, zero_uncovered

_SMALLEST = 512  # pixels of the longer side of the last level, at most
_COLOURS = ("FFFFFF", "FF00FF", "00FF00", "00FFFF", "FFFF00", "FF8000")
_RGB = ("FF0000", "00FF00", "0000FF")


def check_zarr(path: Path) -> None:
    """Refuse an OME-Zarr image before long work where the package that writes it is missing."""
    try:
        import zarr  # noqa: F401
    except ImportError:
        raise OutputError(f"{path}: writing OME-Zarr needs zarr: pip install zarr") from None


def write_ome_zarr(folder: Path, spec: ImageSpec, strips: Iterable[Strip]) -> None:
    """Write an image into a folder; what no image covers is 0."""
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
