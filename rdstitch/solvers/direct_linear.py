"""The homography of many matches without outliers: direct linear transformation (Hartley and Zisserman 2004, 4.1)."""

import numpy as np

from rdstitch.arrays import FloatArray


def direct_linear(x1: FloatArray, x2: FloatArray) -> FloatArray:
    """Homography (3, 3) between undistorted points (N, 2) of two images, positive in front of the camera."""
    lifted = np.column_stack([x1, np.ones(len(x1))])
    zero = np.zeros_like(lifted)
    first = np.concatenate([lifted, zero, -x2[:, :1] * lifted], axis=1)
    second = np.concatenate([zero, lifted, -x2[:, 1:] * lifted], axis=1)
    h: FloatArray = np.linalg.svd(np.concatenate([first, second]), full_matrices=False)[2][-1].reshape(3, 3)
    return h * float(np.copysign(1.0 / np.linalg.norm(h), np.median(lifted @ h[2])))
