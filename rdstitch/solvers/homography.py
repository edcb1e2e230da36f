"""The homography through four points, in closed form, as a function of λ.

Inside a solver the batch axis is last: points of a picture have shape (k, 2, B).

With lifted points ``p(λ) = (x, y, 1 + λ r²)`` let ``α_0 = det(p_1, p_2, p_3)``, and ``α_i`` the same with point i
replaced by point 4; ``β`` likewise in picture 2. Each is linear in λ (:mod:`rdstitch.solvers.orientation`). Then

``H(λ) = Σ_i β_i α_j α_k p̂_i (p_j × p_k)'``

maps ``p_i`` to ``α_0 α_1 α_2 α_3 (β_i / α_i) p̂_i`` for all four points. So the points keep their side of the camera,
and H their orientation, exactly when every ``α_i β_i > 0``, and the sign that puts them in front is that of the product
of all ``α``.
"""

import numpy as np
from numpy.typing import NDArray

from rdstitch.camera import FloatArray
from rdstitch.solvers.orientation import triangle_determinants

# Triangles with an area below this, relative to the largest of the four, count as collinear.
_COLLINEAR = 1e-9


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
    (c1, s1), (c2, s2) = triangle_determinants(x1), triangle_determinants(x2)
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
