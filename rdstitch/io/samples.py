"""What readers and writers of samples share."""

import numpy as np

from rdstitch.arrays import AnyArray, BoolArray, UInt8Array

OPAQUE = 255  # alpha of what is there
ROWS_AT_A_TIME = 128  # rows that are converted at once, so that no second image is in memory


def as_alpha(shown: BoolArray) -> UInt8Array:
    """Opaque where shown, else 0."""
    return np.where(shown, np.uint8(OPAQUE), np.uint8(0))


def split_alpha(samples: AnyArray) -> tuple[AnyArray, AnyArray | None]:
    """Grey (h, w) or colours (h, w, 3), and alpha, of an array of two or four channels; any other as it is."""
    if samples.ndim == 2 or samples.shape[2] not in (2, 4):
        return samples, None
    return (samples[..., 0] if samples.shape[2] == 2 else samples[..., :3]), samples[..., -1]
