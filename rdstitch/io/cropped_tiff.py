"""Cropped TIFF: a part of a canvas with its offset, as Hugin's nona writes it and enblend reads it."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_DPI = 150  # offsets are counted in inches; any resolution will do
_X_POSITION, _Y_POSITION, _FULL_WIDTH, _FULL_LENGTH = 286, 287, 33300, 33301
_RATIONAL, _LONG = 5, 4


def write_cropped_tiff(
    path: Path, pixels: NDArray[Any], alpha: NDArray[np.uint8] | None, offset: tuple[int, int], size: tuple[int, int]
) -> None:
    """Write a part (h, w) or (h, w, C) of a canvas of ``size``, its first pixel at ``offset``; alpha is 0 or 255."""
    import tifffile

    samples = pixels[..., None] if pixels.ndim == 2 else pixels
    colours = 3 if samples.shape[2] == 3 else 1
    extra = ["unspecified"] * (samples.shape[2] - colours)
    if alpha is not None:
        full = np.iinfo(samples.dtype).max if samples.dtype.kind == "u" else 1
        opacity = (alpha.astype(np.float64) / 255.0 * full).astype(samples.dtype)
        samples, extra = np.concatenate([samples, opacity[..., None]], axis=2), [*extra, "unassalpha"]
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
        extratags=[*positions, *whole],
        metadata=None,
        software=False,
    )
