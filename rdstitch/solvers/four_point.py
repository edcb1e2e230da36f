"""Four points, tilt unknown: λ from one constraint of planar motion on the homography through them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray
from rdstitch.geometry.division_model import SOLVED_DISTORTION
from rdstitch.solvers.batch import IndexArray, SampleArrays, solve_in_blocks
from rdstitch.solvers.homography import Quadrangles
from rdstitch.solvers.lines import determinants, oriented_samples, squared_radii
from rdstitch.solvers.plane import lens_range
from rdstitch.solvers.roots import real_roots
from rdstitch.solvers.solutions import Solutions

_QUARTIC_DEGREE = 18
_SEXTIC_DEGREE = 16


def four_point(x1: ArrayLike, x2: ArrayLike, distortion_range: tuple[float, float] = SOLVED_DISTORTION) -> Solutions:
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
        Focal-normalized points of image 1 and image 2.
    distortion_range : (float, float)
        Range of λ (focal-normalized) to search.

    Returns
    -------
    Solutions
        Every real root of either constraint in the range for which all points are in front of the camera and within
        the lens model, and the homography does not mirror.
    """

    def solve(points: FloatArray, _: IndexArray) -> Solutions:
        quadrangles = Quadrangles.of(points)
        usable, low, high = oriented_samples(quadrangles.triangles, *lens_range(points, distortion_range))
        quadrangles = quadrangles.take(usable)
        quartic = real_roots(QuarticEquation.of(quadrangles), _QUARTIC_DEGREE, low, high)
        sextic = real_roots(SexticEquation.of(quadrangles), _SEXTIC_DEGREE, low, high)
        index, distortion = (np.concatenate(pair) for pair in zip(quartic, sextic, strict=True))
        order = np.argsort(index, kind="stable")
        index, distortion = index[order], distortion[order]
        h, possible = quadrangles.take(index).homography(distortion)
        return Solutions(usable[index[possible]], h[possible], distortion[possible])

    return solve_in_blocks(solve, x1, x2, 4)


@dataclass(frozen=True, eq=False)
class QuarticEquation(SampleArrays):
    """The quartic in H that is invariant to rotations of the camera frame, of degree 18 in λ.

    With ``S = (H + H')/2``, ``[v]x = (H - H')/2``, ``A = tr S``, ``t2 = tr S²`` it reads, once ``tr S³`` is written in
    terms of ``det S = det H - v'Sv``,

    ``3 t2² - 3 A⁴ + 4 A² t2 - 4 |v|² (t2 + |v|²) + A (36 det H - 32 v'Sv) = 0``.
    """

    # (2, 17, b): constants and slopes: α_0..3, β_0..3, then for i = 1..3 the first two coordinates of p_j × p_k and the
    # third of p̂_i
    linear: FloatArray
    fixed: FloatArray  # (9, b): what does not depend on λ: the third of p_j × p_k, the first two of p̂_i

    @classmethod
    def of(cls, quadrangles: Quadrangles) -> "QuarticEquation":
        """Set up the equation of samples of four points."""
        second = quadrangles.points[:, 1, :3]
        constant, slope = quadrangles.opposite.constant[:, 0], quadrangles.opposite.slope[:, 0]
        radius2 = squared_radii(second)
        linear = np.empty((2, 17, radius2.shape[-1]))
        linear[:, :8] = quadrangles.triangles.reshape(2, 8, -1)
        linear[0, 8:14], linear[1, 8:14] = constant[:2].reshape(6, -1), slope.reshape(6, -1)
        linear[0, 14:], linear[1, 14:] = 1.0, radius2
        return cls(linear, np.concatenate([constant[2], *second]))

    def homography(self, distortion: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``H(λ)`` (3, 3, ...) for λ of shape (..., b), and its determinant: polynomials in λ."""
        (constant, slope), fixed = self.linear, self.fixed
        if distortion.ndim > 1:
            constant, slope, fixed = constant[:, None], slope[:, None], fixed[:, None]
        linear = constant + slope * distortion
        a0, a1, a2, a3, b0, b1, b2, b3 = linear[:8]
        pairs = np.stack([a2 * a3, a3 * a1, a1 * a2])
        weight = linear[5:8] * pairs
        lines = [weight * line for line in (linear[8:11], linear[11:14], fixed[:3])]
        h = np.array([[np.add.reduce(p * line) for line in lines] for p in (fixed[3:6], fixed[6:], linear[14:])])
        product = a0 * a1 * pairs[0]
        return h, b0 * (b1 * b2 * b3) * (product * product)

    def polynomial(self, distortion: FloatArray) -> FloatArray:
        """The equation itself."""
        h, det = self.homography(distortion)
        symmetric = 0.5 * (h + h.swapaxes(0, 1))
        v = 0.5 * np.stack([h[2, 1] - h[1, 2], h[0, 2] - h[2, 0], h[1, 0] - h[0, 1]])
        trace = h[0, 0] + h[1, 1] + h[2, 2]
        t2 = (symmetric * symmetric).sum(axis=0).sum(axis=0)
        n2 = (v * v).sum(axis=0)
        vsv = (v * (symmetric * v).sum(axis=1)).sum(axis=0)
        a2 = trace * trace
        return np.asarray(
            3.0 * (t2 * t2) + a2 * (4.0 * t2 - 3.0 * a2) - 4.0 * n2 * (t2 + n2) + trace * (36.0 * det - 32.0 * vsv)
        )


@dataclass(frozen=True, eq=False)
class SexticEquation(SampleArrays):
    """``tr(adj H)³ = det(H) tr(H)³`` without its common factor ``(α_0 α_1 α_2 α_3)²``: of degree 16 in λ.

    ``α_0 α_1 α_2 α_3 G³ = β_0 β_1 β_2 β_3 F³`` with ``F = Σ β_i α_j α_k det(p̂_i, p_j, p_k) = tr H`` and G the same
    with the images exchanged.
    """

    # (2, 2, 7, b): constants and slopes; for each image its α, and the determinants of F (image 1) or G; sample
    linear: FloatArray

    @classmethod
    def of(cls, quadrangles: Quadrangles) -> "SexticEquation":
        """Set up the equation of samples of four points."""
        mixed = determinants(quadrangles.points[:, ::-1, :3], quadrangles.opposite)
        return cls(np.concatenate([quadrangles.triangles, mixed], axis=2))

    def polynomial(self, distortion: FloatArray) -> FloatArray:
        """The equation itself."""
        constant, slope = self.linear[:, :, :, None] if distortion.ndim > 1 else self.linear
        linear = constant + slope * distortion
        minors, mixed = linear[:, 1:4], linear[:, 4:]
        m1, m2, m3 = minors.swapaxes(0, 1)
        pairs = np.stack([m2 * m3, m3 * m1, m1 * m2], axis=1)
        product = linear[:, 0] * m1 * pairs[:, 0]
        f, g = (minors[::-1] * pairs * mixed).sum(axis=1)
        return np.asarray(product[0] * (g * g * g) - product[1] * (f * f * f))
