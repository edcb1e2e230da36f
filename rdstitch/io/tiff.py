"""TIFF: tiled, compressed, BigTIFF where needed."""

from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from rdstitch.io.atomic import atomic_output
from rdstitch.io.metadata import Metadata

_TILE = 256
_BIGTIFF_FROM = 2**32 - 2**25
_ICC_PROFILE_TAG = 34675


def write_tiff(path: Path, pixels: NDArray[Any], alpha: NDArray[np.uint8] | None, metadata: Metadata) -> None:
    """Write an array as TIFF; see :func:`rdstitch.io.write.write_image`."""
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    samples = pixels
    if alpha is not None:
        opaque = np.iinfo(pixels.dtype).max if np.issubdtype(pixels.dtype, np.integer) else 1
        full = (alpha.astype(np.float32) / 255 * opaque).astype(pixels.dtype)
        samples = np.dstack([pixels, full])
    with atomic_output(path) as temporary:
        tifffile.imwrite(
            temporary,
            samples,
            bigtiff=samples.nbytes > _BIGTIFF_FROM,
            photometric="rgb" if channels == 3 else "minisblack",
            planarconfig="contig" if samples.ndim == 3 else None,
            extrasamples=_extra_samples(channels, alpha is not None),
            tile=(_TILE, _TILE) if min(pixels.shape[:2]) > _TILE else None,
            compression="zlib",
            compressionargs={"level": 1},
            predictor=True,
            metadata=None,
            software="rdstitch",
            resolution=metadata.dpi,
            resolutionunit="inch" if metadata.dpi else None,
            iccprofile=metadata.icc_profile or None,
        )


def _extra_samples(channels: int, transparent: bool) -> list[str] | None:
    """Meaning of the samples beyond grey or RGB."""
    extra = ["unspecified"] * (channels - (3 if channels == 3 else 1)) + ["unassalpha"] * transparent
    return extra or None
