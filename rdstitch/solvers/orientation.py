"""Orientations of triangles: what tells most impossible samples from possible ones before anything is solved.

Inside a solver the batch axis is last: points of a picture have shape (k, 2, B).

The determinant ``det(p_a, p_b, p_c)`` of lifted points ``p(λ) = (x, y, 1 + λ r²)`` is linear in λ, because two of its
rows do not depend on λ. In front of the camera it has the sign of the triangle's orientation in the plane, whatever the
tilt. A camera that stays on its side of the plane never mirrors a triangle: the determinants of both pictures have
the same sign.
"""

import numpy as np
from numpy.typing import NDArray

from rdstitch.camera import FloatArray


def determinants(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Constant and slope in λ of ``det(p_a, p_b, p_c)`` for points (2, B) each; shape (2, B)."""
    (ax, ay), (bx, by), (cx, cy) = a, b, c
    constant = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    slope = (
        (ax**2 + ay**2) * (bx * cy - by * cx)
        + (bx**2 + by**2) * (cx * ay - cy * ax)
        + (cx**2 + cy**2) * (ax * by - ay * bx)
    )
    return np.stack([constant, slope])


def triangle_determinants(x: FloatArray) -> FloatArray:
    """Determinants of the triangles of the first three or four points: constants and slopes, shape (2, 1 or 4, B).

    First ``det(p_1, p_2, p_3)``; with four points then the same with point 1, 2 and 3 replaced by point 4.
    """
    a, b, c = x[:3]
    if len(x) == 3:
        return determinants(a, b, c)[:, None]
    d = x[3]
    triangles = ((a, b, c), (d, b, c), (a, d, c), (a, b, d))
    return np.stack([determinants(*triangle) for triangle in triangles], axis=1)


def oriented_samples(
    x1: FloatArray, x2: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Samples whose triangles can have equal orientations in both pictures, and ranges of λ narrowed accordingly.

    Between the zeros of the determinants no sign changes, so that the middle of each piece tells for all of it. Most
    samples with a wrong match have no such piece, and need no further work.

    Parameters
    ----------
    x1, x2 : ndarray of shape (k, 2, B)
        Of four or more points, the first four count.
    low, high : ndarray of shape (B,)
        Ranges of λ, empty where ``low < high`` does not hold.

    Returns
    -------
    sample : ndarray of shape (M,), intp
        Samples with any such λ.
    low, high : ndarray of shape (M,)
        From the first to the last piece where all orientations agree.
    """
    first, second = triangle_determinants(x1), triangle_determinants(x2)
    constant, slope = np.concatenate([first, second], axis=1)
    count = len(constant)
    edges = np.empty((count + 2, len(low)))
    edges[0], edges[-1] = low, high
    edges[1:-1] = np.clip(-constant / np.where(slope != 0.0, slope, 1e-300), low, high)
    edges[1:-1].sort(axis=0)
    middle = 0.5 * (edges[1:] + edges[:-1])
    positive = constant[:, None] + slope[:, None] * middle > 0.0
    kept = (positive[: count // 2] == positive[count // 2 :]).all(axis=0) & (edges[1:] > edges[:-1])
    sample = np.flatnonzero(kept.any(axis=0))
    kept, edges = kept[:, sample], edges[:, sample]
    return (
        sample,
        np.where(kept, edges[:-1], np.inf).min(axis=0),
        np.where(kept, edges[1:], -np.inf).max(axis=0),
    )


def mirrored(x1: FloatArray, x2: FloatArray, distortion: FloatArray) -> NDArray[np.bool_]:
    """Whether any triangle has opposite orientations for one λ a sample (M,); shape (M,)."""
    (c1, s1), (c2, s2) = triangle_determinants(x1), triangle_determinants(x2)
    return np.asarray(((c1 + s1 * distortion) * (c2 + s2 * distortion) < 0.0).any(axis=0))
