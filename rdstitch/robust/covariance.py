"""Covariance of λ and of a pair's model, where neighbouring errors are alike."""

import numpy as np

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.robust.measurements import Measurements

_SINGULAR = 1e-13  # eigenvalue of the correlation matrix of the parameters
_CELLS_PER_HALF_DIAGONAL = 5.0
_CELLS_PER_SIDE = 64  # more than an image has, wherever its distortion centre is


def covariances(
    information: FloatArray, influence: FloatArray, jacobian: FloatArray, noise: FloatArray, data: Measurements
) -> FloatArray:
    """Covariance (B, P, P) that holds also where neighbouring errors are alike, as parallax and lens misfit make them.

    ``A⁻¹ (Σ_c g_c g_c') A⁻¹`` over the cells c of a grid, ``A`` the normal matrix and ``g_c`` the gradient of the
    matches in a cell (White's estimator with clusters), but in no direction less than ``noise² A⁻¹``, what independent
    errors give. Infinite where a parameter is not determined.

    ``information`` (B, P, P); ``influence`` (B, N, E): each match's share of the gradient by other parameters;
    ``jacobian`` (B, E, P): derivatives of these; ``noise`` (B,): standard deviation of the errors per axis, pixels.
    """
    result = np.full(information.shape, np.inf)
    scale = np.sqrt(np.einsum("bpp->bp", information))
    usable = np.flatnonzero((scale > 0.0).all(axis=1) & np.isfinite(information).all(axis=(1, 2)))
    scale = scale[usable]
    values, vectors = np.linalg.eigh(information[usable] / (scale[:, :, None] * scale[:, None]))
    determined = values[:, 0] >= _SINGULAR
    usable, values, vectors, scale = usable[determined], values[determined], vectors[determined], scale[determined]
    if not len(usable):
        return result
    # In the basis of this root noise² A⁻¹ is the identity.
    root = (vectors / np.sqrt(values)[:, None]) / scale[:, :, None]
    of_cells, pair = _summed_over_cells(influence[usable], data.x1[usable])
    starts = np.searchsorted(pair, np.arange(len(usable)))
    outer = np.add.reduceat(of_cells[:, :, None] * of_cells[:, None], starts, axis=0)
    turn = jacobian[usable] @ root
    clustered = np.swapaxes(turn, 1, 2) @ (outer / (noise[usable] ** 2)[:, None, None]) @ turn
    result[usable] = (noise[usable] ** 2)[:, None, None] * enlarged(root, clustered)
    return result


def enlarged(root: FloatArray, other: FloatArray) -> FloatArray:
    """Covariances ``R R'`` (..., P, P), in no direction less than others, which are given in the basis of R.

    There the first are the identity, so that the larger of the two is a matter of eigenvalues.
    """
    spread, directions = np.linalg.eigh(other)
    larger = root @ (directions * np.sqrt(np.maximum(spread, 1.0))[..., None, :])
    return np.asarray(larger @ np.swapaxes(larger, -1, -2))


def _summed_over_cells(values: FloatArray, points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Sums (C, P) of values (B, N, P) over the cells of a grid in which points (B, 2, N) lie, and each cell's pair."""
    batch, count, size = values.shape
    cell = np.floor(points * _CELLS_PER_HALF_DIAGONAL + _CELLS_PER_SIDE // 2)
    cell = np.clip(cell, 0, _CELLS_PER_SIDE - 1).astype(np.intp)
    key = ((np.arange(batch)[:, None] * _CELLS_PER_SIDE + cell[:, 0]) * _CELLS_PER_SIDE + cell[:, 1]).ravel()
    order = np.argsort(key, kind="stable")
    ordered = key[order]
    starts = np.flatnonzero(np.diff(ordered, prepend=-1))
    sums: FloatArray = np.add.reduceat(values.reshape(batch * count, size)[order], starts, axis=0)
    return sums, ordered[starts] // _CELLS_PER_SIDE**2
