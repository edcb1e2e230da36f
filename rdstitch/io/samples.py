"""What readers and writers of samples share."""

OPAQUE = 255
"""Alpha of what is there."""

ROWS_AT_A_TIME = 128
"""Rows that are converted at once, so that no second image is in memory."""
