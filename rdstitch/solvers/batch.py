"""Batches of samples: blocks that stay in cache, with the batch axis last.

Inside a solver the points of both images are one array of shape (2, 2, k, b): coordinate, image, point, sample.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rdstitch.arrays import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.solvers.solutions import Solutions

IndexArray = NDArray[np.intp]
BlockSolver = Callable[[FloatArray, IndexArray], Solutions]


@dataclass(frozen=True)
class SampleArrays:
    """Numbers per sample: arrays whose last axis is that of the samples."""

    def take(self, samples: IndexArray) -> Self:
        """The arrays of some samples; indices may repeat."""
        arrays = (getattr(self, field.name) for field in fields(self))
        taken = (a.take(samples) if isinstance(a, SampleArrays) else np.take(a, samples, axis=-1) for a in arrays)
        return type(self)(*taken)


def sample_count(x1: ArrayLike) -> int:
    """Number of samples of a batch (B, k, 2), or 1 of one sample (k, 2)."""
    return int(np.shape(x1)[0]) if np.ndim(x1) == 3 else 1


def solve_in_blocks(solve: BlockSolver, x1: ArrayLike, x2: ArrayLike, count: int, block_size: int = 4096) -> Solutions:
    """Check a batch of samples, and solve it block by block; ArgumentError when a shape is wrong.

    Samples (B, count, 2), or one (count, 2), with a coordinate that is not finite have no solution. ``solve`` takes the
    points of a block, (2, 2, count, b), and the place of the block's samples in the batch, (b,).
    """
    a, b = np.asarray(x1, dtype=np.float64), np.asarray(x2, dtype=np.float64)
    if a.shape != b.shape or a.ndim not in (2, 3) or a.shape[-2:] != (count, 2):
        raise ArgumentError(
            f"expected two arrays of shape (B, {count}, 2) or ({count}, 2), not {a.shape} and {b.shape}"
        )
    a, b = a.reshape(-1, count, 2), b.reshape(-1, count, 2)
    index = np.arange(len(a))
    parts = []
    # A degenerate sample divides by zero on its way to being rejected.
    with np.errstate(all="ignore"):
        if not np.isfinite(a.sum() + b.sum()):
            index = np.flatnonzero(np.isfinite(a).all(axis=(1, 2)) & np.isfinite(b).all(axis=(1, 2)))
            a, b = a[index], b[index]
        for start in range(0, len(a), block_size):
            block = slice(start, start + block_size)
            points = np.ascontiguousarray(np.stack([a[block].T, b[block].T], axis=1))
            part = solve(points, index[block])
            parts.append(replace(part, sample=index[part.sample + start]))
    return Solutions.concatenate(parts) if parts else Solutions.empty()
