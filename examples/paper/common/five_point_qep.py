"""Five points, general homography, as Fitzgibbon's quadratic eigenvalue problem: the baseline."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.arrays import FloatArray
from rdstitch.geometry.division_model import SOLVED_DISTORTION
from rdstitch.solvers.batch import IndexArray, solve_in_blocks
from rdstitch.solvers.plane import lens_range
from rdstitch.solvers.solutions import Solutions

# Imaginary parts below this, relative to the eigenvalue, are rounding errors of a real eigenvalue.
_REAL = 1e-7
# Determinants below this, of homographies of unit norm, mean that the points do not determine it.
_SINGULAR = 1e-9


def five_point_qep(
    x1: ArrayLike, x2: ArrayLike, distortion_range: tuple[float, float] = SOLVED_DISTORTION
) -> Solutions:
    """The same as :func:`rdstitch.solvers.five_point`, by a quadratic eigenvalue problem (Fitzgibbon, CVPR 2001, §5).

    The two rows per point of the direct linear transformation that contain the lifted coordinate of image 2 are
    quadratic in λ, ``(D_0 + λ D_1 + λ² D_2) h = 0``, 10 equations for 9 entries of H. The pseudoinverse of the matrix
    at one λ outside the range makes them square, and linearization gives an 18 x 18 eigenvalue problem for
    ``1 / (λ - that λ)``.

    :func:`rdstitch.solvers.five_point` is many times faster. This solver spreads noise over all ten equations.
    """
    shift = distortion_range[1] + 0.1 * (distortion_range[1] - distortion_range[0])

    def solve(points: FloatArray, _: IndexArray) -> Solutions:
        low, high = lens_range(points, distortion_range)
        # LAPACK raises where the fourth powers in the matrices overflow.
        usable = np.flatnonzero((low < high) & np.isfinite((points**4).sum(axis=(0, 1, 2))))
        a, b = points[..., usable].transpose(1, 3, 2, 0)
        eigenvalues, vectors = np.linalg.eig(_companion(*_shifted(_dlt_rows(a, b), shift)))
        real = (np.abs(eigenvalues.imag) <= _REAL * np.abs(eigenvalues)) & (eigenvalues.real != 0.0)
        sample, which = np.nonzero(real)
        distortion = shift + 1.0 / eigenvalues.real[sample, which]
        h, possible = _in_front(vectors.real[sample, 9:, which].reshape(-1, 3, 3), a[sample], distortion)
        index = usable[sample]
        possible &= (distortion > low[index]) & (distortion < high[index])
        return Solutions(index[possible], h[possible], distortion[possible])

    return solve_in_blocks(solve, x1, x2, 5)


def _dlt_rows(x1: FloatArray, x2: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``D_0, D_1, D_2`` for points (B, 5, 2), each of shape (B, 10, 9)."""
    constant = np.concatenate([x1, np.ones_like(x1[..., :1])], axis=-1)
    slope = np.zeros_like(constant)
    slope[..., 2] = np.einsum("bki,bki->bk", x1, x1)
    radius2 = np.einsum("bki,bki->bk", x2, x2)[..., None]
    rows = np.zeros((3, len(x1), 2, 5, 3, 3))
    # Third coordinate 1 + λ r̂² of image 2 times p: for row 0 against H's row 0, for row 1 against its row 1.
    for row in (0, 1):
        rows[0, :, row, :, row] = constant
        rows[1, :, row, :, row] = slope + radius2 * constant
        rows[2, :, row, :, row] = radius2 * slope
        rows[0, :, row, :, 2] = -x2[..., row, None] * constant
        rows[1, :, row, :, 2] = -x2[..., row, None] * slope
    zeroth, first, second = rows.reshape(3, len(x1), 10, 9)
    return zeroth, first, second


def _shifted(
    matrices: tuple[FloatArray, FloatArray, FloatArray], shift: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The same quadratic polynomial in ``λ - shift``."""
    d0, d1, d2 = matrices
    return d0 + shift * (d1 + shift * d2), d1 + 2.0 * shift * d2, d2


def _companion(a0: FloatArray, a1: FloatArray, a2: FloatArray) -> FloatArray:
    """Companion matrices (B, 18, 18) of ``μ² a0 + μ a1 + a2``."""
    inverse = np.linalg.pinv(a0)
    companion = np.zeros((len(a0), 18, 18))
    companion[:, :9, :9] = -inverse @ a1
    companion[:, :9, 9:] = -inverse @ a2
    companion[:, 9:, :9] = np.eye(9)
    return companion


def _in_front(homography: FloatArray, x1: FloatArray, distortion: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Homographies (M, 3, 3) of unit norm and the sign that fits points (M, 5, 2), and whether one does."""
    norm = np.linalg.norm(homography, axis=(1, 2), keepdims=True)
    h = homography / np.where(norm > 0.0, norm, 1.0)
    third = 1.0 + distortion[:, None] * np.einsum("mki,mki->mk", x1, x1)
    depth = np.einsum("mi,mki->mk", h[:, 2, :2], x1) + h[:, 2, 2, None] * third
    h = h * np.sign(depth[:, 0])[:, None, None]
    same_side = (depth * depth[:, :1] > 0.0).all(axis=1)
    return h, same_side & (np.linalg.det(h) > _SINGULAR)
