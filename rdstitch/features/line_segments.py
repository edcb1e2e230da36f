"""Straight edges in an image, by the line segment detector of Grompone von Gioi et al. (2010)."""

from typing import Any

import cv2
import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.features.prepared_image import View, prepare

MEGAPIXELS = 0.6  # of the images that edges are found in
_CLEARANCE = 3.0  # pixels that an edge keeps from what is masked


def line_segments(view: View) -> tuple[FloatArray, float]:
    """Ends of the edges (N, 2, 2), pixels of the whole image, and how many of these a pixel of the detector takes."""
    image = prepare(view, MEGAPIXELS)
    lines: Any = cv2.createLineSegmentDetector().detect(image.grey)[0]
    ends = np.reshape(np.empty(0) if lines is None else lines, (-1, 2)).astype(np.float64)
    clear = image.covers(ends, np.full(len(ends), _CLEARANCE)).reshape(-1, 2).all(axis=1)
    return image.to_full_size(ends).reshape(-1, 2, 2)[clear], float(image.factor.max())
