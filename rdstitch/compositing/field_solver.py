"""Least squares for the fields of many pictures, in memory that grows with their number and not with its square.

A direct factorization couples the nodes of every picture with those of all that overlap it, and fills in between.
Conjugate gradients need only the products with the design matrix. Their preconditioner has two levels: what each
picture's own measurements say of its nodes, and one level of each picture, solved for all together (additive Schwarz
with a coarse space; Nicolaides 1987), which carries what is common to many pictures across the set.
"""

from collections.abc import Callable

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from rdstitch.arrays import FloatArray

# Energy norm of the error, as a share of that of the solution: far below a grey level.
_TOLERANCE, _MAX_STEPS = 1e-8, 3000
_ROWS = 10_000  # of the design that are taken at a time
_PICTURES = 256  # whose own nodes are solved for at a time


def solve_fields(
    parts: tuple[sparse.csr_array, sparse.csr_array],
    weight: FloatArray,
    values: FloatArray,
    prior: tuple[sparse.csr_array, FloatArray],
    start: FloatArray,
) -> FloatArray:
    """Weighted least squares of ``(parts[0] + parts[1]) x = values`` with a prior.

    Parameters
    ----------
    parts : two sparse arrays of shape (M, N B²)
        Each row of either concerns the nodes of one picture.
    weight : ndarray of shape (M,)
    values : ndarray of shape (M, C)
    prior : (sparse array of shape (N B², N B²), ndarray of shape (N B², C))
        Precision, one block per picture, and its product with what is expected.
    start : ndarray of shape (N, B, B, C)
        Where the iteration begins.

    Returns
    -------
    ndarray of shape (N, B, B, C)
    """
    precision, expected = prior
    count, side, _, channels = start.shape
    design = sparse.csr_array(parts[0] + parts[1])
    own = _inverse_blocks(parts, weight, precision, side**2)
    spread = sparse.csr_array(sparse.kron(sparse.eye_array(count), np.ones((side**2, 1))))
    coarse = spread.T @ precision @ spread
    for rows in (slice(k, k + _ROWS) for k in range(0, len(weight), _ROWS)):
        there = design[rows] @ spread
        coarse = coarse + there.T @ sparse.diags_array(weight[rows]) @ there
    common = splu(sparse.csc_array(coarse), permc_spec="MMD_AT_PLUS_A")

    def product(x: FloatArray) -> FloatArray:
        return np.asarray(design.T @ (weight[:, None] * np.asarray(design @ x)) + precision @ x)

    def precondition(x: FloatArray) -> FloatArray:
        of_each = (own @ x.reshape(count, side**2, channels)).reshape(x.shape)
        return np.asarray(of_each + spread @ common.solve(np.asarray(spread.T @ x)))

    right = np.asarray(design.T @ (weight[:, None] * values) + expected)
    return _conjugate_gradients(product, precondition, right, start.reshape(-1, channels)).reshape(start.shape)


def _inverse_blocks(
    parts: tuple[sparse.csr_array, sparse.csr_array], weight: FloatArray, precision: sparse.csr_array, nodes: int
) -> FloatArray:
    """Inverses (N, nodes, nodes) of what prior and measurements say of each picture's nodes, the others given."""
    blocks: FloatArray = sparse.bsr_array(precision, blocksize=(nodes, nodes)).data.copy()
    scale = sparse.diags_array(weight)
    for part in map(sparse.csc_array, parts):
        for first in range(0, len(blocks), _PICTURES):
            some = part[:, first * nodes : (first + _PICTURES) * nodes]
            found = sparse.bsr_array(some.T @ scale @ some, blocksize=(nodes, nodes))
            blocks[first + found.indices] += found.data
    for first in range(0, len(blocks), _PICTURES):
        blocks[first : first + _PICTURES] = np.linalg.inv(blocks[first : first + _PICTURES])
    return blocks


def _conjugate_gradients(
    product: Callable[[FloatArray], FloatArray],
    precondition: Callable[[FloatArray], FloatArray],
    right: FloatArray,
    start: FloatArray,
) -> FloatArray:
    """Preconditioned conjugate gradients for each column of ``right`` (n, C), all at once."""
    x, left = start, right - product(start)
    direction = better = precondition(left)
    enough = _TOLERANCE**2 * _dots(right, precondition(right))
    error = _dots(left, better)
    for _ in range(_MAX_STEPS):
        # Columns that are done stand still.
        going = error > enough
        if not going.any():
            break
        image = product(direction)
        step = np.where(going, error / np.where(going, _dots(direction, image), 1.0), 0.0)
        x, left = x + step * direction, left - step * image
        better = precondition(left)
        error, before = np.where(going, _dots(left, better), error), error
        direction = better + np.where(going, error / np.where(going, before, 1.0), 0.0) * direction
    return x


def _dots(a: FloatArray, b: FloatArray) -> FloatArray:
    """Inner products of columns; not by BLAS, whose sums depend on its number of threads."""
    return np.asarray(np.einsum("nc,nc->c", a, b), dtype=np.float64)
