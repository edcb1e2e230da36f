"""The homography through four points, in closed form, as a function of λ.

With lifted points ``p(λ) = (x, y, 1 + λ r²)`` let ``α_0 = det(p_1, p_2, p_3)``, and ``α_i`` the same with point i
replaced by point 4; ``β`` likewise in image 2. Each is linear in λ (:mod:`rdstitch.solvers.lines`). Then

``H(λ) = Σ_i β_i α_j α_k p̂_i (p_j × p_k)'``

maps ``p_i`` to ``α_0 α_1 α_2 α_3 (β_i / α_i) p̂_i`` for all four points. So the points keep their side of the camera,
and H their orientation, exactly when every ``α_i β_i > 0``, and the sign that puts them in front is that of the product
of all ``α``.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray
from rdstitch.solvers.batch import SampleArrays
from rdstitch.solvers.lines import Lines, squared_radii, triangle_determinants

# Triangles with an area below this, relative to the largest of the four, count as collinear.
_COLLINEAR = 1e-9


@dataclass(frozen=True, eq=False)
class Quadrangles(SampleArrays):
    """Samples of four or more points, of which the first four have a homography for every λ."""

    points: FloatArray  # (2, 2, k, b)
    opposite: Lines  # ``p_j × p_k`` of the first three points
    triangles: FloatArray  # (2, 2, 4, b): ``α_0..3`` and ``β_0..3``, constants and slopes

    @classmethod
    def of(cls, points: FloatArray) -> "Quadrangles":
        """Prepare points (2, 2, k, b)."""
        opposite = Lines.opposite(points)
        return cls(points, opposite, triangle_determinants(points, opposite))

    def homography(self, distortion: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """H (b, 3, 3) for one λ a sample (b,), with unit Frobenius norm and the points in front of the camera.

        It is not possible, (b,), where the points change sides, are mirrored, or three are collinear.
        """
        minors = self.triangles[0] + self.triangles[1] * distortion
        size = np.abs(minors)
        possible = (size.min(axis=1) > _COLLINEAR * size.max(axis=1)).all(axis=0)
        alpha, beta = minors
        possible &= (alpha * beta > 0.0).all(axis=0)

        first, second, third = alpha[1:]
        weight = beta[1:] * np.stack([second * third, third * first, first * second])
        lines = self.opposite.at(distortion)[:, 0] * weight
        images = self.points[:, 1, :3]
        lifted = (*images, 1.0 + squared_radii(images) * distortion)
        h = np.stack([(row * lines).sum(axis=1) for row in lifted])
        norm = np.sqrt((h * h).sum(axis=0).sum(axis=0))
        scale = np.sign(alpha[0] * first * (second * third)) / np.where(norm > 0.0, norm, np.inf)
        return np.ascontiguousarray((h * scale).transpose(2, 0, 1)), possible


def direct_linear(x1: FloatArray, x2: FloatArray) -> FloatArray:
    """Fit the homography (3, 3), positive in front of the camera, to undistorted points (N, 2) of two images.

    By the direct linear transformation (Hartley and Zisserman 2004, 4.1), without outliers.
    """
    lifted = np.column_stack([x1, np.ones(len(x1))])
    zero = np.zeros_like(lifted)
    first = np.concatenate([lifted, zero, -x2[:, :1] * lifted], axis=1)
    second = np.concatenate([zero, lifted, -x2[:, 1:] * lifted], axis=1)
    h: FloatArray = np.linalg.svd(np.concatenate([first, second]), full_matrices=False)[2][-1].reshape(3, 3)
    return h * float(np.copysign(1.0 / np.linalg.norm(h), np.median(lifted @ h[2])))
