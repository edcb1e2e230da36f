"""TIFF files of a part of a canvas, as Hugin's nona writes them and enblend reads them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.io.strips import with_alpha
from rdstitch.io.tiff import ExtraTag
from rdstitch.system.late_imports import tifffile

_DPI = 150  # offsets are counted in inches; any resolution will do
_X_POSITION, _Y_POSITION, _FULL_WIDTH, _FULL_LENGTH = 286, 287, 33300, 33301
_RATIONAL, _LONG = 5, 4


def write_cropped_tiff(
    path: Path,
    pixels: NDArray[Any],
    alpha: NDArray[np.uint8] | None,
    offset: tuple[int, int],
    size: tuple[int, int],
    extra_tags: Sequence[ExtraTag] = (),
) -> None:
    """Write a part (h, w) or (h, w, C) of a canvas of ``size``, its first pixel at ``offset``; alpha is 0 or 255."""
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
