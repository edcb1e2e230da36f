"""What readers and writers of images have in common."""

from typing import Any

from numpy.typing import NDArray

Pixels = NDArray[Any]

OPAQUE = 255
"""Alpha of what an image shows entirely."""

ROWS_AT_A_TIME = 128
"""Rows that are converted together, so that what that takes is small beside the image."""
