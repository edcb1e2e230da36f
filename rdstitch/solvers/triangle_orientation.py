"""Orientations of triangles: what tells most impossible samples from possible ones before anything is solved.

In front of the camera the determinant of three lifted points (:mod:`rdstitch.solvers.lines`) has the sign of the
triangle's orientation in the plane, whatever the tilt. A camera that stays on its side of the plane never mirrors a
triangle: the determinants of both images have the same sign.
"""

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray


def oriented_samples(
    triangles: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Samples (M,) whose triangles can have equal orientations in both images, and the ranges of λ for that.

    Of ranges (b,), empty where ``low < high`` does not hold, and :func:`rdstitch.solvers.lines.triangle_determinants`
    (2, 2, T, b). Between the zeros of the determinants no sign changes, so that the middle of each piece tells for all
    of it; a range goes from the first to the last piece where all orientations agree. Most samples with a wrong match
    have no such piece, and need no further work.
    """
    batch = len(low)
    constant, slope = triangles.reshape(2, -1, batch)
    count = len(constant)
    edges = np.empty((count + 2, batch))
    edges[0], edges[-1] = low, high
    zeros = edges[1:-1]
    np.divide(constant, slope, out=zeros)
    np.negative(zeros, out=zeros)
    # Of a determinant that does not depend on λ: infinite, or if it is zero NaN.
    np.fmin(np.fmax(zeros, low, out=zeros), high, out=zeros)
    zeros.sort(axis=0)
    middle = 0.5 * (edges[1:] + edges[:-1])
    positive = constant[:, None] + slope[:, None] * middle > 0.0
    kept = (positive[: count // 2] == positive[count // 2 :]).all(axis=0)
    kept &= edges[1:] > edges[:-1]
    sample = np.flatnonzero(kept.any(axis=0))
    kept, edges = kept[:, sample], edges[:, sample]
    return (sample, np.where(kept, edges[:-1], np.inf).min(axis=0), np.where(kept, edges[1:], -np.inf).max(axis=0))


def mirrored(triangles: FloatArray, distortion: FloatArray) -> NDArray[np.bool_]:
    """Test for triangles of opposite orientations, for one λ a sample (M,); shape (M,)."""
    constant, slope = triangles
    first, second = constant + slope * distortion
    return np.asarray((first * second < 0.0).any(axis=0))
