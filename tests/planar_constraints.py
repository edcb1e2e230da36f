"""Constraints on homographies of planar motion that solvers and instances are checked by."""

import numpy as np
from numpy.typing import ArrayLike

from rdstitch.arrays import FloatArray


def constraint_residuals(homography: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Residuals of two constraints that every planar-motion homography satisfies (Valtonen Örnhag et al., §3).

    With ``S = (H + H')/2``, ``[v]x = (H - H')/2``, ``A = tr S``, ``t2 = tr S²``, ``t3 = tr S³``:

    * the quartic that is invariant to rotations of the camera frame,
      ``3A⁴ - 14A² t2 + 3 t2² - 4 t2 |v|² - 4|v|⁴ + 12 A t3 + 4 A v'Sv = 0``;
    * the sextic ``tr(adj H)³ = det(H) tr(H)³``.

    ``homography``: in focal-normalized coordinates. The scale cancels: both are computed for unit Frobenius norm; shape
    (..., 3, 3). Returns shape (...).
    """
    h = np.asarray(homography, dtype=np.float64)
    h = h / np.linalg.norm(h, axis=(-2, -1), keepdims=True)
    transposed = np.swapaxes(h, -2, -1)
    s, skew = (h + transposed) / 2, (h - transposed) / 2
    v = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    a = np.einsum("...ii->...", s)
    t2 = np.einsum("...ij,...ji->...", s, s)
    t3 = np.einsum("...ij,...jk,...ki->...", s, s, s)
    v2 = np.einsum("...i,...i->...", v, v)
    vsv = np.einsum("...i,...ij,...j->...", v, s, v)
    quartic = 3 * a**4 - 14 * a**2 * t2 + 3 * t2**2 - 4 * t2 * v2 - 4 * v2**2 + 12 * a * t3 + 4 * a * vsv
    trace_adjugate = (a**2 - np.einsum("...ij,...ji->...", h, h)) / 2
    sextic = trace_adjugate**3 - np.linalg.det(h) * a**3
    return quartic, sextic
