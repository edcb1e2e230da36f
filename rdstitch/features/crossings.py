"""Crossings of two edges, as between the squares of a chessboard: saddle points of the grey values."""

import cv2
import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.features.prepared_image import PreparedImage

_SIGMA = 1.5  # pixels, of the smoothing
_WINDOW = 9  # pixels on a side, in which there is no stronger one
_CLEARANCE = 5.0  # pixels from what is masked
_MOST = 4000  # the strongest
_MIN_STRENGTH = 0.02  # of the strongest of the image: it has a seventh of the contrast
_MIN_BALANCE = 0.1  # of the larger curvature that the smaller one has: edges have less
_STEPS = 5  # of Newton's method
_FARTHEST = 1.5  # pixels that it may lead in all
_FLAT = 1e-6  # grey levels² per pixel⁴: a product of curvatures that is none


def find_crossings(image: PreparedImage) -> FloatArray:
    """Crossings in an image, pixels of its full size (N, 2).

    Around the crossing of two straight edges the image looks the same when it is turned by 180 degrees, at any
    perspective: smoothing does not move it, whereas it moves the middle of a blob.
    """
    smooth = cv2.GaussianBlur(image.grey.astype(np.float32), (0, 0), _SIGMA)
    xx, xy, yy = (cv2.Sobel(smooth, cv2.CV_32F, *order, scale=0.25) for order in ((2, 0), (1, 1), (0, 2)))
    strength = xy * xy
    strength -= xx * yy
    peak = strength >= cv2.dilate(strength, np.ones((_WINDOW, _WINDOW), dtype=np.uint8))
    strongest = np.sort(strength[peak])[-_MOST:]
    peak &= strength >= max(strongest[0], _MIN_STRENGTH * strongest[-1], _FLAT)
    del strength  # large, as the next ones are
    x, y = (cv2.Sobel(smooth, cv2.CV_32F, *order, scale=0.125) for order in ((1, 0), (0, 1)))
    # Of the two curvatures, which have different signs, the smaller and the larger.
    mean, half = np.abs(0.5 * (xx + yy)[peak]), np.hypot(0.5 * (xx - yy)[peak], xy[peak])
    balanced = half - mean > _MIN_BALANCE * (half + mean)
    start = np.argwhere(peak)[balanced, ::-1].astype(np.float64)
    points = start
    for _ in range(_STEPS if len(start) else 0):
        u, v = points.astype(np.float32).T
        gx, gy, a, b, c = (cv2.remap(of, u, v, cv2.INTER_LINEAR).ravel().astype(float) for of in (x, y, xx, xy, yy))
        step = np.column_stack([c * gx - b * gy, a * gy - b * gx]) / np.minimum(a * c - b * b, -_FLAT)[:, None]
        points = np.clip(points - step, start - 2.0 * _FARTHEST, start + 2.0 * _FARTHEST)
    near = np.linalg.norm(points - start, axis=1) < _FARTHEST
    crossings = points[near & image.covers(points, np.full(len(points), _CLEARANCE))]
    return image.to_full_size(crossings)
