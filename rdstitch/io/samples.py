"""What readers and writers of samples share."""

import numpy as np

from rdstitch.arrays import BoolArray, UInt8Array

OPAQUE = 255  # alpha of what is there
ROWS_AT_A_TIME = 128  # rows that are converted at once, so that no second image is in memory


def as_alpha(shown: BoolArray) -> UInt8Array:
    """Opaque where shown, else 0."""
    return np.where(shown, np.uint8(OPAQUE), np.uint8(0))
