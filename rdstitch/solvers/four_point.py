"""Four points, tilt unknown: λ from one constraint of planar motion on the homography through them."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.camera import FloatArray
from rdstitch.solvers.batch import SampleArrays, solve_in_blocks
from rdstitch.solvers.homography import homography_through
from rdstitch.solvers.orientation import determinants, oriented_samples, triangle_determinants
from rdstitch.solvers.plane import lens_range
from rdstitch.solvers.roots import real_roots
from rdstitch.solvers.solutions import Solutions

_QUARTIC_DEGREE = 18
_SEXTIC_DEGREE = 16
_CYCLES = ((0, 1, 2), (1, 2, 0), (2, 0, 1))


def four_point(x1: ArrayLike, x2: ArrayLike, distortion_range: tuple[float, float] = (-1.5, 0.5)) -> Solutions:
    """Planar motion with unknown tilt, and λ, from four points (the relaxation of Valtonen Örnhag et al., §4.1).

    For fixed λ the points give the homography (:mod:`rdstitch.solvers.homography`), and λ is a root of one
    constraint of planar motion on it. Four points give two equations more than there are unknowns, so that which
    constraint is a choice. The roots of two compete: the quartic of :class:`QuarticEquation`, which nearly touches zero
    at many a truth and then loses it under noise, and the sextic of :class:`SexticEquation`. With points at 0.001 focal
    lengths of noise the quartic has a λ within 0.02 of the truth in 30 % of samples, the sextic in 28 %, both in 33 %
    (for small yaw 36 %, 31 %, 47 %). Without noise they agree, and the solution comes twice.

    Parameters
    ----------
    x1, x2 : array_like of shape (B, 4, 2) or (4, 2)
        Focal-normalized points of picture 1 and picture 2.
    distortion_range : (float, float)
        Range of λ (focal-normalized) to search.

    Returns
    -------
    Solutions
        Every real root of either constraint in the range for which all points are in front of the camera and within
        the lens model, and the homography does not mirror.

    Raises
    ------
    ArgumentError
        When a shape is wrong or the range is empty.
    """

    def solve(a: FloatArray, b: FloatArray, _: NDArray[np.intp]) -> Solutions:
        usable, low, high = oriented_samples(a, b, *lens_range(a, b, distortion_range))
        a, b = np.take(a, usable, axis=-1), np.take(b, usable, axis=-1)
        quartic = real_roots(QuarticEquation.from_points(a, b), _QUARTIC_DEGREE, low, high)
        sextic = real_roots(SexticEquation.from_points(a, b), _SEXTIC_DEGREE, low, high)
        index, distortion = (np.concatenate(pair) for pair in zip(quartic, sextic, strict=True))
        order = np.argsort(index, kind="stable")
        index, distortion = index[order], distortion[order]
        h, possible = homography_through(np.take(a, index, axis=-1), np.take(b, index, axis=-1), distortion)
        return Solutions(usable[index[possible]], h[possible], distortion[possible])

    return solve_in_blocks(solve, x1, x2, 4)


class QuarticEquation(SampleArrays):
    """The quartic in H that is invariant to rotations of the camera frame, of degree 18 in λ.

    With ``S = (H + H')/2``, ``[v]x = (H - H')/2``, ``A = tr S``, ``t2 = tr S²`` it reads, once ``tr S³`` is written in
    terms of ``det S = det H - v'Sv``,

    ``3 t2² - 3 A⁴ + 4 A² t2 - 4 |v|² (t2 + |v|²) + A (36 det H - 32 v'Sv) = 0``.

    Rows: α_0..3, β_0..3, then for i = 1..3 the third coordinate of p̂_i and the first two of p_j × p_k (all
    these constant and slope), and what does not depend on λ: p̂_i's first two and the third of p_j × p_k.
    """

    @classmethod
    def from_points(cls, x1: FloatArray, x2: FloatArray) -> "QuarticEquation":
        """From points of shape (4, 2, B)."""
        alpha, beta = triangle_determinants(x1), triangle_determinants(x2)
        x, y = x1[:3].swapaxes(0, 1)
        r2, q2 = x**2 + y**2, x2[:3, 0] ** 2 + x2[:3, 1] ** 2
        (xj, yj, rj), (xk, yk, rk) = ([v[order] for v in (x, y, r2)] for order in ([1, 2, 0], [2, 0, 1]))
        linear = [
            np.concatenate([alpha[0], beta[0], np.ones_like(q2), yj - yk, xk - xj]),
            np.concatenate([alpha[1], beta[1], q2, yj * rk - yk * rj, xk * rj - xj * rk]),
        ]
        fixed = np.concatenate([x2[:3, 0], x2[:3, 1], xj * yk - xk * yj])
        return cls(np.concatenate([*linear, fixed]))

    def _homography(self, distortion: FloatArray) -> tuple[list[list[FloatArray]], FloatArray]:
        """Entries of H and its determinant."""
        rows = self.rows[:, None] if distortion.ndim > 1 else self.rows
        linear = rows[:17] + rows[17:34] * distortion
        a0, b0 = linear[0], linear[4]
        alpha, beta = linear[1:4], linear[5:8]
        third, line_x, line_y = linear[8:11], linear[11:14], linear[14:17]
        first, second, line_z = rows[34:37], rows[37:40], rows[40:43]
        pairs = np.stack([alpha[1] * alpha[2], alpha[2] * alpha[0], alpha[0] * alpha[1]])
        weight = beta * pairs
        lines = [weight * line_x, weight * line_y, weight * line_z]
        h = [[np.add.reduce(p * line) for line in lines] for p in (first, second, third)]
        product = a0 * alpha[0] * pairs[0]
        return h, b0 * (beta[0] * beta[1] * beta[2]) * product**2

    def polynomial(self, distortion: FloatArray) -> FloatArray:
        """The equation itself."""
        ((h00, h01, h02), (h10, h11, h12), (h20, h21, h22)), det = self._homography(distortion)
        s01, s02, s12 = 0.5 * (h01 + h10), 0.5 * (h02 + h20), 0.5 * (h12 + h21)
        v0, v1, v2 = 0.5 * (h21 - h12), 0.5 * (h02 - h20), 0.5 * (h10 - h01)
        trace = h00 + h11 + h22
        t2 = h00**2 + h11**2 + h22**2 + 2.0 * (s01**2 + s02**2 + s12**2)
        n2 = v0**2 + v1**2 + v2**2
        vsv = v0 * (h00 * v0 + 2.0 * (s01 * v1 + s02 * v2)) + v1 * (h11 * v1 + 2.0 * s12 * v2) + h22 * v2**2
        a2 = trace**2
        value: FloatArray = (
            3.0 * t2**2 + a2 * (4.0 * t2 - 3.0 * a2) - 4.0 * n2 * (t2 + n2) + trace * (36.0 * det - 32.0 * vsv)
        )
        return value


class SexticEquation(SampleArrays):
    """``tr(adj H)³ = det(H) tr(H)³`` without its common factor ``(α_0 α_1 α_2 α_3)²``: of degree 16 in λ.

    ``α_0 α_1 α_2 α_3 G³ = β_0 β_1 β_2 β_3 F³`` with ``F = Σ β_i α_j α_k det(p̂_i, p_j, p_k) = tr H`` and G the same
    with the pictures exchanged. Rows: α, β, the determinants of F, those of G; constants, then slopes.
    """

    @classmethod
    def from_points(cls, x1: FloatArray, x2: FloatArray) -> "SexticEquation":
        """From points of shape (4, 2, B)."""
        mixed = [
            np.stack([determinants(x[i], y[j], y[k]) for i, j, k in _CYCLES], axis=1) for x, y in ((x2, x1), (x1, x2))
        ]
        return cls(np.concatenate([triangle_determinants(x1), triangle_determinants(x2), *mixed], axis=1))

    def _sides(self, distortion: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Products of α and β, F and G."""
        constant, slope = self.rows[:, :, None] if distortion.ndim > 1 else self.rows
        linear = constant + slope * distortion
        a0, a1, a2, a3, b0, b1, b2, b3, f1, f2, f3, g1, g2, g3 = linear
        a12, a13, a23, b12, b13, b23 = a1 * a2, a1 * a3, a2 * a3, b1 * b2, b1 * b3, b2 * b3
        f = b1 * a23 * f1 + b2 * a13 * f2 + b3 * a12 * f3
        g = a1 * b23 * g1 + a2 * b13 * g2 + a3 * b12 * g3
        return a0 * a1 * a23, b0 * b1 * b23, f, g

    def polynomial(self, distortion: FloatArray) -> FloatArray:
        """The equation itself."""
        a, b, f, g = self._sides(distortion)
        return a * g * g**2 - b * f * f**2
