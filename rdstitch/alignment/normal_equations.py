"""Normal equations of the adjustment: what the links sum up, chained into sparse blocks.

The model's derivatives turn the Gram matrix of each link into the blocks of its two images and of the shared
parameters. Which poses the links couple is the pattern of the matrix, the same at every step.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rdstitch.alignment.link_equations import LinkEquations
from rdstitch.alignment.motion_models import ModelMatrices
from rdstitch.alignment.observations import Observations
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.radial_homography import inverses
from rdstitch.system.late_imports import sparse, sparse_linalg


@dataclass(frozen=True, eq=False)
class PoseBlocks:
    """The normal matrix of F free pose parameters, put together from blocks of L links."""

    # (L, 2 D): which of the free parameters those of the link's two images are; F for those that are not free
    column: IntArray
    free: int  # F
    kept: BoolArray  # (L, 2 D, 2 D): entries of the links' blocks between free parameters
    place: IntArray  # (K,): where each of these is added in the E entries of the matrix
    indices: IntArray  # indices, indptr: of the matrix by columns; all of its diagonal is stored
    indptr: IntArray
    diagonal: IntArray  # (F,): where the diagonal lies in the entries

    @classmethod
    def of(cls, observations: Observations, free: BoolArray) -> Self:
        """Of links between N images, whose parameters (N, D) may move where ``free``."""
        total = int(free.sum())
        number = np.where(free, np.cumsum(free.reshape(-1)).reshape(free.shape) - 1, total)
        column = np.concatenate([number[observations.image1], number[observations.image2]], axis=1)
        across, down = np.broadcast_arrays(column[:, None, :], column[:, :, None])
        kept = (across < total) & (down < total)
        of_diagonal = np.arange(total) * (total + 1)
        entries, place = np.unique(
            np.concatenate([across[kept] * total + down[kept], of_diagonal]), return_inverse=True
        )
        places, diagonal = np.split(place.reshape(-1), [int(kept.sum())])
        indptr = np.searchsorted(entries, np.arange(total + 1) * total)
        indices = entries % max(total, 1)
        return cls(column, total, kept, places, indices.astype(np.int32), indptr.astype(np.int32), diagonal)

    def entries(self, local: FloatArray) -> FloatArray:
        """Entries of the matrix (E,) that is the sum of blocks (L, 2 D, 2 D)."""
        return np.bincount(self.place, local[self.kept], minlength=len(self.indices)).astype(np.float64)

    def with_diagonal(self, entries: FloatArray, added: FloatArray) -> FloatArray:
        """The entries (E,) with something (F,) added to the diagonal."""
        entries = entries.copy()
        entries[self.diagonal] += added
        return entries

    def matrix(self, entries: FloatArray) -> "sparse.csc_array":
        """The matrix of some entries (E,)."""
        return sparse.csc_array((entries, self.indices, self.indptr), shape=(self.free, self.free))

    def sums(self, values: FloatArray) -> FloatArray:
        """Of values (L, 2 D, ...) of each link the sum for each free parameter, (F, ...)."""
        total = np.zeros((self.free + 1, *values.shape[2:]))
        np.add.at(total, self.column, values)
        return total[:-1]


_LEAST_DAMPING = 1e-12
"""Relative to the diagonal: what makes poses solvable that nothing holds."""


@dataclass(frozen=True)
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
        reduced, solved = replace(self, gradient_poses=gradient_poses)._eliminate(_LEAST_DAMPING)
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

    def _eliminate(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """The Schur complement (S, S) and ``A⁻¹ [B, gradient]``."""
        right = np.column_stack([self.coupling, self.gradient_poses])
        if self.blocks.free == 0:
            return self.shared, right
        diagonal = self.poses[self.blocks.diagonal]
        floor = max(float(diagonal.max()), 1e-300) * 1e-14
        damped = self.blocks.with_diagonal(self.poses, damping * diagonal + floor)
        options = {"SymmetricMode": True}
        factor = sparse_linalg.splu(
            self.blocks.matrix(damped), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
        )
        solved = factor.solve(right)
        return self.shared - self.coupling.T @ solved[:, : self.coupling.shape[1]], solved


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

    def add_to(self, local: FloatArray, gradient: FloatArray, observations: Observations) -> None:
        """Add them to those (L, P, P) and (L, P) of links, each to one of its image, by 2 D poses and S + K others."""
        images, row = np.unique(np.concatenate([observations.image1, observations.image2]), return_index=True)
        second, link = np.divmod(row[np.searchsorted(images, self.image)], len(observations))
        size = local.shape[1] - self.derivative.shape[2]
        poses, others = np.arange(size), np.arange(2 * size, local.shape[1])
        column = np.concatenate([second[:, None] * size + poses, np.tile(others, (len(second), 1))], axis=1)
        weighted = self.derivative * self.precision[:, None, None]
        products = np.swapaxes(weighted, 1, 2) @ self.derivative
        np.add.at(local, (link[:, None, None], column[:, :, None], column[:, None]), products)
        np.add.at(gradient, (link[:, None], column), np.einsum("mip,mi->mp", weighted, self.errors))


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
    derivative = link_derivatives(observations, model, homographies, equations.gram.shape[1] - 9)
    size = model.by_pose.shape[1]
    local = np.swapaxes(derivative, 1, 2) @ equations.gram @ derivative * weight
    gradient = np.einsum("lpk,lp->lk", derivative, equations.gradient) * weight
    if known is not None:
        known.add_to(local, gradient, observations)

    pair = 2 * size
    return SparseNormalEquations(
        blocks,
        blocks.entries(local[:, :pair, :pair]),
        blocks.sums(local[:, :pair, pair:]),
        local[:, pair:, pair:].sum(axis=0),
        blocks.sums(gradient[:, :pair]),
        gradient[:, pair:].sum(axis=0),
    )


def link_derivatives(
    observations: Observations, model: ModelMatrices, homographies: FloatArray, lens_count: int
) -> FloatArray:
    """Derivatives of each link's homography and K parameters of the lens, shape (L, 9 + K, 2 D + S + K).

    By the poses of its two images, the shared parameters of the model, and those of the lens.
    """
    i, j = observations.image1, observations.image2
    count = len(observations)
    inverse = inverses(model.matrices)[i][:, None]
    along = homographies[:, None]
    by_parts = [
        -along @ model.by_pose[i] @ inverse,
        model.by_pose[j] @ inverse,
        model.by_shared[j] @ inverse - along @ model.by_shared[i] @ inverse,
    ]
    by_homography = np.concatenate(by_parts, axis=1).reshape(count, -1, 9)
    width, lens = by_homography.shape[1], np.arange(lens_count)
    derivative = np.zeros((count, 9 + len(lens), width + len(lens)))
    derivative[:, :9, :width] = np.swapaxes(by_homography, 1, 2)
    derivative[:, 9 + lens, width + lens] = 1.0
    return derivative
