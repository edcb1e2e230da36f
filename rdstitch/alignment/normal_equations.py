"""Normal equations of the adjustment: what the links sum up, chained into sparse blocks.

The model's derivatives turn the Gram matrix of each link into the blocks of its two images and of the shared
parameters. Which poses the links couple is the pattern of the matrix, the same at every step.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from rdstitch.alignment.link_equations import LinkEquations
from rdstitch.alignment.motion_models import ModelMatrices
from rdstitch.alignment.observations import Observations
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.radial_homography import inverses
from rdstitch.system.late_imports import sparse, sparse_linalg

_LINKS_AT_ONCE = 4096
"""Whose dense blocks are made at a time: those of all links would be most of an alignment's memory."""


@dataclass(frozen=True, eq=False)
class PoseBlocks:
    """The normal matrix of F free pose parameters, put together from blocks of L links."""

    # (L, 2 D): which of the free parameters those of the link's two images are; F for those that are not free
    column: IntArray
    free: int  # F
    rank: IntArray  # (L, 2 D): which of the free parameters of its image each of them is
    above: IntArray  # (L, 2, 2): entries above the block of two sides of a link, row and column, in each of its columns
    indices: IntArray  # indices, indptr: of the matrix of E entries by columns; all of its diagonal is stored
    indptr: IntArray
    diagonal: IntArray  # (F,): where the diagonal lies in the entries

    @classmethod
    def of(cls, observations: Observations, free: BoolArray) -> Self:
        """Of links between N images, whose parameters (N, D) may move where ``free``."""
        total, count, sizes = int(free.sum()), len(free), free.sum(axis=1)
        number = np.where(free, np.cumsum(free.reshape(-1)).reshape(free.shape) - 1, total)
        rank, first = np.cumsum(free, axis=1) - 1, np.cumsum(sizes) - sizes
        sides = np.stack([observations.image1, observations.image2], axis=1)
        key_of_sides = sides[:, None, :] * count + sides[:, :, None]
        # A block of each two images that a link joins, and of each with itself, one column of blocks after another.
        key = np.unique(np.concatenate([key_of_sides.ravel(), np.arange(count) * (count + 1)]))
        across, down = np.divmod(key, count)
        rows = np.cumsum(sizes[down]) - sizes[down]
        start = rows[np.searchsorted(across, np.arange(count))]
        above, height = rows - start[across], np.bincount(across, sizes[down], count).astype(np.intp)
        of_column = np.repeat(np.arange(count), sizes)
        indptr = np.concatenate([[0], np.cumsum(height[of_column])])
        row = np.repeat(first[down] - rows, sizes[down]) + np.arange(int(sizes[down].sum()))
        place = np.repeat(start[of_column] - indptr[:-1], height[of_column]) + np.arange(indptr[-1])
        own = above[np.searchsorted(key, of_column * (count + 1))]
        return cls(
            number[sides].reshape(len(sides), -1).astype(np.int32),
            total,
            rank[sides].reshape(len(sides), -1).astype(np.int32),
            above[np.searchsorted(key, key_of_sides)].astype(np.int32),
            row[place].astype(np.int32),
            indptr.astype(np.int32),
            indptr[:-1] + own + rank[free],
        )

    def entries(self, links: slice, local: FloatArray) -> FloatArray:
        """Entries of the matrix (E,) that is the sum of blocks (l, 2 D, 2 D) of some links."""
        column, rank = self.column[links], self.rank[links]
        size = column.shape[1] // 2
        above = np.repeat(np.repeat(self.above[links], size, axis=1), size, axis=2)
        place = self.indptr[column][:, None, :] + above + rank[:, :, None]
        kept = (column[:, None, :] < self.free) & (column[:, :, None] < self.free)
        return np.bincount(place[kept], local[kept], minlength=len(self.indices)).astype(np.float64)

    def with_diagonal(self, entries: FloatArray, added: FloatArray) -> FloatArray:
        """The entries (E,) with something (F,) added to the diagonal."""
        entries = entries.copy()
        entries[self.diagonal] += added
        return entries

    def matrix(self, entries: FloatArray) -> "sparse.csc_array":
        """The matrix of some entries (E,)."""
        return sparse.csc_array((entries, self.indices, self.indptr), shape=(self.free, self.free))

    def sums(self, links: slice, values: FloatArray) -> FloatArray:
        """Of values (l, 2 D, ...) of some links the sum for each free parameter, (F, ...)."""
        total = np.zeros((self.free + 1, *values.shape[2:]))
        np.add.at(total, self.column[links], values)
        return total[:-1]


_LEAST_DAMPING = 1e-12
"""Relative to the diagonal: what makes poses solvable that nothing holds."""


@dataclass(frozen=True, eq=False)
class SparseNormalEquations:
    """``[A B; B' C] step = -gradient`` for poses and shared parameters, in that order."""

    blocks: PoseBlocks  # the pattern of A
    poses: FloatArray  # (E,): the entries of A, (F, F), of the F free pose parameters
    coupling: FloatArray  # (F, S): B
    shared: FloatArray  # (S, S): C
    gradient_poses: FloatArray  # gradient_poses, gradient_shared: (F,) and (S,)
    gradient_shared: FloatArray

    def solve(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """The step of poses and shared parameters, with the diagonal enlarged by ``1 + damping`` (Marquardt)."""
        reduced, solved = self._eliminate(damping)
        diagonal = np.diag(np.diag(self.shared)) * damping
        right = self.coupling.T @ solved[:, -1] - self.gradient_shared
        step_shared = _solve_scaled(reduced + diagonal, right)
        return -solved[:, -1] - solved[:, :-1] @ step_shared, step_shared

    def responses(self, gradient_poses: FloatArray, gradient_shared: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The steps, (F, C) and (S, C), for C gradients (F, C) and (S, C) in place of the equations' own."""
        kept = self.coupling.shape[1]
        reduced, solved = self._eliminate(_LEAST_DAMPING, gradient_poses)
        step_shared = _solve_scaled(reduced, self.coupling.T @ solved[:, kept:] - gradient_shared)
        return -solved[:, kept:] - solved[:, :kept] @ step_shared, step_shared

    def with_priors(
        self,
        precision_poses: FloatArray,
        error_poses: FloatArray,
        information_shared: FloatArray,
        gradient_shared: FloatArray,
    ) -> Self:
        """With priors added: on the poses as inverse variances and distances from the means, both (F,)."""
        return replace(
            self,
            poses=self.blocks.with_diagonal(self.poses, precision_poses),
            shared=self.shared + information_shared,
            gradient_poses=self.gradient_poses + precision_poses * error_poses,
            gradient_shared=self.gradient_shared + gradient_shared,
        )

    def shared_information(self) -> FloatArray:
        """Information (S, S) on the shared parameters when nothing is known of the poses: ``C - B' A⁻¹ B``.

        Poses that nothing holds are damped as little as makes them solvable; where nothing does, nothing is known.
        """
        for damping in (0.0, 1e-12, 1e-8, 1e-4):
            try:
                information = self._eliminate(damping)[0]
            except RuntimeError:  # singular
                continue
            if np.isfinite(information).all():
                return information
        return np.zeros_like(self.shared)

    def pose_response(self) -> FloatArray:
        """How the poses follow a unit step of each shared parameter, shape (F, S): ``-A⁻¹ B``."""
        response: FloatArray = -self._eliminate(_LEAST_DAMPING)[1][:, : self.coupling.shape[1]]
        return response

    def _eliminate(self, damping: float, gradient: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """The Schur complement (S, S) and ``A⁻¹ [B, gradient]``, of the equations' own gradient if not given."""
        right = np.column_stack([self.coupling, self.gradient_poses if gradient is None else gradient])
        if self.blocks.free == 0:
            return self.shared, right
        factor = self._least_damped if damping == _LEAST_DAMPING else self._factorized(damping)
        solved = factor.solve(right)
        return self.shared - self.coupling.T @ solved[:, : self.coupling.shape[1]], solved

    @cached_property
    def _least_damped(self) -> Any:
        """The factors that all responses have in common."""
        return self._factorized(_LEAST_DAMPING)

    def _factorized(self, damping: float) -> Any:
        diagonal = self.poses[self.blocks.diagonal]
        floor = max(float(diagonal.max()), 1e-300) * 1e-14
        damped = self.blocks.with_diagonal(self.poses, damping * diagonal + floor)
        options = {"SymmetricMode": True}
        return sparse_linalg.splu(
            self.blocks.matrix(damped), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
        )


def _solve_scaled(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Least-norm solution of a small symmetric system, in units in which its diagonal is one; of one or several."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    kept = values > 1e-12
    inverse = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
    # The last axis of what is scaled is that of the system.
    solution: FloatArray = scale * (vectors @ (inverse * (vectors.T @ (scale * right.T).T).T).T).T
    return solution.T


@dataclass(frozen=True, eq=False)
class ImageEquations:
    """Errors of single images, whatever the others are."""

    image: IntArray  # (M,)
    derivative: FloatArray  # (M, 2, D + S + K): by the image's pose, the shared parameters, and the lens
    errors: FloatArray  # (M, 2)
    precision: FloatArray  # (M,): inverse variance

    def add_to(self, local: FloatArray, gradient: FloatArray, observations: Observations, links: slice) -> None:
        """Add them to those (l, P, P) and (l, P) of some links, by 2 D poses and S + K others.

        That is the same link of all, so that the other links get nothing.
        """
        images, row = np.unique(np.concatenate([observations.image1, observations.image2]), return_index=True)
        second, link = np.divmod(row[np.searchsorted(images, self.image)], len(observations))
        chosen = (links.start <= link) & (link < links.stop)
        second, link = second[chosen], link[chosen] - links.start
        size = local.shape[1] - self.derivative.shape[2]
        poses, others = np.arange(size), np.arange(2 * size, local.shape[1])
        column = np.concatenate([second[:, None] * size + poses, np.tile(others, (len(second), 1))], axis=1)
        weighted = self.derivative[chosen] * self.precision[chosen, None, None]
        products = np.swapaxes(weighted, 1, 2) @ self.derivative[chosen]
        np.add.at(local, (link[:, None, None], column[:, :, None], column[:, None]), products)
        np.add.at(gradient, (link[:, None], column), np.einsum("mip,mi->mp", weighted, self.errors[chosen]))


def chain(
    equations: LinkEquations,
    observations: Observations,
    model: ModelMatrices,
    homographies: FloatArray,
    blocks: PoseBlocks,
    weight: float,
    known: ImageEquations | None = None,
) -> SparseNormalEquations:
    """Chain the equations of the links with the derivatives of the model, whose shared parameters the lens follows.

    The homographies are those of the links (L, 3, 3), the weight is one over the variance of the errors; what is
    ``known`` of single images comes besides.
    """
    size, others = model.by_pose.shape[1], model.by_shared.shape[1] + equations.gram.shape[1] - 9
    pair, free = 2 * size, blocks.free
    poses, coupling, gradient_poses = np.zeros(len(blocks.indices)), np.zeros((free, others)), np.zeros(free)
    shared, gradient_shared = np.zeros((others, others)), np.zeros(others)
    for first in range(0, len(observations), _LINKS_AT_ONCE):
        links = slice(first, min(first + _LINKS_AT_ONCE, len(observations)))
        derivative = link_derivatives(observations, model, homographies, equations.gram.shape[1] - 9, links)
        local = np.swapaxes(derivative, 1, 2) @ equations.gram[links] @ derivative * weight
        gradient = np.einsum("lpk,lp->lk", derivative, equations.gradient[links]) * weight
        if known is not None:
            known.add_to(local, gradient, observations, links)
        poses += blocks.entries(links, local[:, :pair, :pair])
        coupling += blocks.sums(links, local[:, :pair, pair:])
        shared += local[:, pair:, pair:].sum(axis=0)
        gradient_poses += blocks.sums(links, gradient[:, :pair])
        gradient_shared += gradient[:, pair:].sum(axis=0)
    return SparseNormalEquations(blocks, poses, coupling, shared, gradient_poses, gradient_shared)


def link_derivatives(
    observations: Observations, model: ModelMatrices, homographies: FloatArray, lens_count: int, links: slice
) -> FloatArray:
    """Derivatives of some links' homographies and K parameters of the lens, shape (l, 9 + K, 2 D + S + K).

    By the poses of its two images, the shared parameters of the model, and those of the lens.
    """
    i, j = observations.image1[links], observations.image2[links]
    inverse = inverses(model.matrices[i])[:, None]
    along = homographies[links, None]
    by_parts = [
        -along @ model.by_pose[i] @ inverse,
        model.by_pose[j] @ inverse,
        model.by_shared[j] @ inverse - along @ model.by_shared[i] @ inverse,
    ]
    by_homography = np.concatenate(by_parts, axis=1).reshape(len(i), -1, 9)
    width, lens = by_homography.shape[1], np.arange(lens_count)
    derivative = np.zeros((len(i), 9 + len(lens), width + len(lens)))
    derivative[:, :9, :width] = np.swapaxes(by_homography, 1, 2)
    derivative[:, 9 + lens, width + lens] = 1.0
    return derivative
