"""The homography through four points, in closed form, as a function of λ.

Inside a solver the batch axis is last: points of a picture have shape (k, 2, B).

With lifted points ``p(λ) = (x, y, 1 + λ r²)`` let ``α_0 = det(p_1, p_2, p_3)``, and ``α_i`` the same with point i
replaced by point 4; ``β`` likewise in picture 2. Each is linear in λ, because two of the three rows do not depend on
it. Then

``H(λ) = Σ_i β_i α_j α_k p̂_i (p_j × p_k)'``

maps ``p_i`` to ``α_0 α_1 α_2 α_3 (β_i / α_i) p̂_i`` for all four points. So the points keep their side of the camera,
and H their orientation, exactly when every ``α_i β_i > 0``, and the sign that puts them in front is that of the product
of all ``α``.
"""

import numpy as np
from numpy.typing import NDArray

from rdstitch.camera import FloatArray

# Triangles with an area below this, relative to the largest of the four, count as collinear.
_COLLINEAR = 1e-9


def determinants(a: FloatArray, b: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Constant and slope in λ of ``det(p_a, p_b, p_c)`` for points (2, B) each."""
    (ax, ay), (bx, by), (cx, cy) = a, b, c
    constant = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    slope = (
        (ax**2 + ay**2) * (bx * cy - by * cx)
        + (bx**2 + by**2) * (cx * ay - cy * ax)
        + (cx**2 + cy**2) * (ax * by - ay * bx)
    )
    return constant, slope


def replaced_determinants(x: FloatArray) -> FloatArray:
    """``α_0, α_1, α_2, α_3`` of points (4 or more, 2, B): constants and slopes, shape (2, 4, B)."""
    a, b, c, d = x[:4]
    both = [determinants(a, b, c), determinants(d, b, c), determinants(a, d, c), determinants(a, b, d)]
    return np.stack([np.stack([pair[i] for pair in both]) for i in (0, 1)])


def oriented_samples(
    x1: FloatArray, x2: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Narrow ranges of λ to the part where the first four points are not mirrored and keep their side of the camera.

    The eight determinants are linear in λ. Between their zeros no sign changes, so that the middle of each piece tells
    for all of it. Most samples with a wrong match have no such piece, and need no further work.

    Parameters
    ----------
    x1, x2 : ndarray of shape (4 or more, 2, B)
    low, high : ndarray of shape (B,)

    Returns
    -------
    sample : ndarray of shape (M,), intp
        Samples with any such λ.
    low, high : ndarray of shape (M,)
        From the first to the last piece where every ``α_i β_i > 0``.
    """
    constant, slope = np.concatenate([replaced_determinants(x1), replaced_determinants(x2)], axis=1)
    edges = np.empty((10, len(low)))
    edges[0], edges[-1] = low, high
    edges[1:-1] = np.clip(-constant / np.where(slope != 0.0, slope, 1e-300), low, high)
    edges[1:-1].sort(axis=0)
    middle = 0.5 * (edges[1:] + edges[:-1])
    positive = constant[:, None] + slope[:, None] * middle > 0.0
    kept = (positive[:4] == positive[4:]).all(axis=0) & (edges[1:] > edges[:-1])
    sample = np.flatnonzero(kept.any(axis=0))
    kept, edges = kept[:, sample], edges[:, sample]
    return (
        sample,
        np.where(kept, edges[:-1], np.inf).min(axis=0),
        np.where(kept, edges[1:], -np.inf).max(axis=0),
    )


def homography_through(x1: FloatArray, x2: FloatArray, distortion: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Homography of the first four points for one λ a sample.

    Parameters
    ----------
    x1, x2 : ndarray of shape (4 or more, 2, M)
    distortion : ndarray of shape (M,)

    Returns
    -------
    homography : ndarray of shape (M, 3, 3)
        With unit Frobenius norm, and the sign that puts the points in front of the camera.
    possible : ndarray of shape (M,), bool
        False where the points change sides, are mirrored, or three are collinear.
    """
    (c1, s1), (c2, s2) = replaced_determinants(x1), replaced_determinants(x2)
    alpha, beta = c1 + s1 * distortion, c2 + s2 * distortion
    possible = np.ones(len(distortion), dtype=np.bool_)
    for minors in (alpha, beta):
        size = np.abs(minors)
        possible &= size.min(axis=0) > _COLLINEAR * size.max(axis=0)
    possible &= (alpha * beta > 0.0).all(axis=0)

    third1, third2 = (1.0 + distortion * (x[:3, 0] ** 2 + x[:3, 1] ** 2) for x in (x1, x2))
    h = np.zeros((3, 3, len(distortion)))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        (xj, yj), (xk, yk) = x1[j], x1[k]
        weight = beta[i + 1] * alpha[j + 1] * alpha[k + 1]
        line = np.stack([yj * third1[k] - yk * third1[j], xk * third1[j] - xj * third1[k], xj * yk - xk * yj])
        h += np.stack([x2[i, 0], x2[i, 1], third2[i]])[:, None] * (weight * line)
    norm = np.sqrt(np.einsum("ijm,ijm->m", h, h))
    scale = np.sign(alpha.prod(axis=0)) / np.where(norm > 0.0, norm, np.inf)
    return np.ascontiguousarray(np.moveaxis(h * scale, -1, 0)), possible
