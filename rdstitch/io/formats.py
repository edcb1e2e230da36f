"""What the formats of outputs can hold, by the suffix, and whether an image fits; found out before long work."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rdstitch.errors import LimitError, OutputError
from rdstitch.io.strips import ImageSpec
from rdstitch.io.write_ome import check_zarr
from rdstitch.system.output_checks import check_suffix


@dataclass(frozen=True)
class Format:
    """Limits of a format, or of its one encoder."""

    max_side: int | None = None  # pixels
    any_samples: bool = False  # floating point, and any number of channels instead of one or three
    bytes_per_pixel: int = 0  # of memory, where the encoder takes the image whole


FORMATS = {
    **dict.fromkeys((".jpg", ".jpeg"), Format(max_side=65_500)),
    ".png": Format(max_side=1_000_000),
    **dict.fromkeys((".tif", ".tiff"), Format(any_samples=True)),
    # The samples, Pillow's copy of them, the encoder's own, and the output; measured: 13 to 16 with 4 and 16 MPix.
    ".webp": Format(max_side=16_383, bytes_per_pixel=20),
    ".dzi": Format(),
    ".zarr": Format(any_samples=True),
}


def check_format(path: str | Path, spec: ImageSpec) -> None:
    """Refuse an image that the format of ``path`` cannot hold."""
    file = check_suffix(path)
    suffix = file.suffix.lower()
    if suffix == ".zarr":
        check_zarr(file)
    if not FORMATS[suffix].any_samples:
        if spec.channels not in (1, 3):
            raise OutputError(f"{path}: {spec.channels} channels do not fit into {suffix[1:]}; write a .tif")
        if spec.dtype == np.float32:
            raise OutputError(f"{path}: floating-point samples do not fit into {suffix[1:]}; write a .tif")
    check_size(path, spec.size)


def check_size(path: str | Path, size: tuple[int, int]) -> None:
    """Refuse an image of ``size`` (width, height) that the format of ``path`` cannot hold."""
    suffix = Path(path).suffix.lower()
    limit = FORMATS.get(suffix, Format()).max_side
    if limit is not None and max(size) > limit:
        raise LimitError(
            f"{path}: {size[0]} x {size[1]} pixels is more than {suffix[1:]} can hold ({limit} pixels a side); "
            "write a .tif, or use a smaller --scale"
        )


def check_memory(path: str | Path, size: tuple[int, int], max_memory: int | None) -> None:
    """Refuse an image that the format of ``path`` needs whole in memory, where that is limited."""
    suffix = Path(path).suffix.lower()
    need = size[0] * size[1] * FORMATS.get(suffix, Format()).bytes_per_pixel
    if max_memory is not None and need > max_memory:
        raise LimitError(
            f"{path}: {size[0]} x {size[1]} pixels of WebP need {need / 2**20:.0f} MB, and --max-memory allows "
            f"{max_memory / 2**20:.0f} MB; write a .tif, .png or .jpg, which are written in strips"
        )
