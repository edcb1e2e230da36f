"""Robust least squares over the cells of overlaps, with a prior, in memory that grows with the number of images."""

from typing import Any, NamedTuple

import numpy as np

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.compositing.overlap_cells import Cells
from rdstitch.numerics.conjugate_gradients import conjugate_gradients
from rdstitch.system.late_imports import sparse, sparse_linalg

VISIBLE = 0.004  # log units, a grey level of a light sample: differences below are as good as none
DECIMALS = 5  # of solutions, that are kept: far below a grey level
_TUKEY = 3.0  # standard deviations from which on an error counts for nothing
_CORE = 0.3  # fraction of the cells of an overlap with which its mode is sought: the rest may be other content
_CORE_SIGMA = 0.385  # standard deviations within which that fraction of normal errors lies
_ROUNDS = 6
_TOLERANCE = 1e-4  # residual, as a share of the right side: far below a grey level


class Prior(NamedTuple):
    """What is expected of the unknowns (K,), before any cell is looked at."""

    precision: "sparse.csr_array"  # (K, K)
    weighted_mean: FloatArray  # (K, C): what is expected, multiplied by the precision
    block: int  # unknowns of an image
    # (block, S): shapes of an image's unknowns that are solved for all images at once; None where an image has but one
    shapes: FloatArray | None = None


def fit_robustly(
    cells: Cells,
    design: "sparse.csr_array",
    weight: FloatArray,
    values: FloatArray,
    prior: Prior,
    clipped_weight: float = 0.0,
    workers: int = 1,
) -> tuple[FloatArray, FloatArray]:
    """Solution (K, C) of ``design x = values`` (M, C) and the errors, by iteratively reweighted least squares."""
    errors = values - _modes(values, cells.pair, cells.evidence)
    solution = np.zeros((design.shape[1], values.shape[1]))
    for _ in range(_ROUNDS):
        size = np.abs(errors).max(axis=1)
        order = np.argsort(size, kind="stable")
        total = np.cumsum(cells.evidence[order])
        scale = max(float(size[order[np.searchsorted(total, _CORE * total[-1])]]) / _CORE_SIGMA, VISIBLE)
        robust = weight * (1.0 - (size / (_TUKEY * scale)) ** 2).clip(0.0) ** 2
        robust[cells.darkened(errors)] = clipped_weight
        solution = solve(design, robust, values, prior, solution, workers)
        errors, before = values - design @ solution, errors
        if np.abs(errors - before).max() < VISIBLE:
            break
    return np.round(solution, DECIMALS), errors


def _modes(values: FloatArray, pair: IntArray, evidence: FloatArray) -> FloatArray:
    """The mode of the values (M, C) of each cell's pair (M, C), a channel at a time.

    The middle of an interval as long as the shortest that holds a core of the evidence, and that holds the most of it.
    """
    number = np.cumsum(np.diff(pair, prepend=pair[0]) > 0)
    first = np.flatnonzero(np.diff(number, prepend=-1))
    stop = np.append(first[1:], len(pair))
    weight = evidence + 1e-9
    core = _CORE * np.add.reduceat(weight, first)
    modes = np.empty((len(first), values.shape[1]))
    for channel in range(values.shape[1]):
        order = np.lexsort((values[:, channel], number))
        value, total = values[order, channel], np.append(0.0, np.cumsum(weight[order]))
        last = np.searchsorted(total[1:], (total[:-1] + core[number]) * (1.0 - 1e-12))
        length = np.where(last < stop[number], value[np.minimum(last, len(value) - 1)] - value, np.inf)
        longest = np.maximum(np.minimum.reduceat(length, first), VISIBLE)[number]
        # One ascending line of numbers, on which every pair has a stretch of its own.
        line = value + number * (2.0 * (float(np.ptp(value)) + float(longest.max())))
        end = np.searchsorted(line, line + longest, side="right")
        best = np.lexsort((total[end] - total[:-1], number))[stop - 1]
        sums = np.append(0.0, np.cumsum(weight[order] * value))
        modes[:, channel] = (sums[end[best]] - sums[best]) / (total[end[best]] - total[best])
    return modes[number]


def solve(
    design: "sparse.csr_array",
    weight: FloatArray,
    values: FloatArray,
    prior: Prior,
    start: FloatArray,
    workers: int = 1,
) -> FloatArray:
    """Weighted least squares by conjugate gradients, preconditioned by the inverse of the part of each image.

    And, of unknowns that vary smoothly over an image, by that of their smooth shapes in all images: what many images
    have in common goes from each to the next only, step by step, otherwise.
    """
    weighted = design.copy()
    weighted.data *= np.repeat(weight, np.diff(design.indptr))
    # No larger than the design, whose rows every step would go through twice otherwise.
    normal = sparse.csr_array(weighted.T @ design + prior.precision)
    right = weighted.T @ values + prior.weighted_mean
    entries, block = normal.tocoo(), prior.block
    diagonal = entries.row // block == entries.col // block
    row, column = entries.row[diagonal], entries.col[diagonal]
    blocks = np.zeros((len(right) // block, block, block))
    blocks[row // block, row % block, column % block] = entries.data[diagonal]
    inverse = np.linalg.inv(blocks)

    def of_images(left: FloatArray) -> FloatArray:
        return np.asarray((inverse @ left.reshape(-1, block, left.shape[1])).reshape(left.shape))

    if prior.shapes is None:
        return conjugate_gradients(normal, right, start, of_images, _TOLERANCE, workers)
    smooth: Any = sparse.csr_array(sparse.kron(sparse.eye_array(len(blocks)), prior.shapes))
    factor: Any = sparse_linalg.splu(sparse.csc_array(smooth.T @ normal @ smooth))

    def of_all(left: FloatArray) -> FloatArray:
        return np.asarray(of_images(left) + smooth @ factor.solve(smooth.T @ left))

    return conjugate_gradients(normal, right, start, of_all, _TOLERANCE, workers)
