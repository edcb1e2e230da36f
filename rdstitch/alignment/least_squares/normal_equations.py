"""Normal equations of the adjustment: what the links sum up, chained into sparse blocks.

The model's derivatives turn the Gram matrix of each link into the blocks of its two images and of the shared
parameters. Which poses the links couple is the pattern of the matrix, the same at every step.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from rdstitch.alignment.least_squares.block_cholesky import BlockCholesky, Elimination
from rdstitch.alignment.least_squares.link_equations import LinkEquations
from rdstitch.alignment.least_squares.observations import Observations
from rdstitch.alignment.motion_models import ModelMatrices
from rdstitch.arrays import BoolArray, FloatArray, IntArray
from rdstitch.geometry.radial_homography import inverses
from rdstitch.system.late_imports import sparse

_LINKS_AT_ONCE = 1024
"""Whose dense blocks are made at a time: those of all links would be most of an alignment's memory."""


_DAMPINGS = (0.0, 1e-12, 1e-8, 1e-4)
"""Relative to the diagonal, from none up: the least of them makes poses solvable that nothing holds."""


@dataclass(frozen=True, eq=False)
class SparseNormalEquations:
    """``[A B; B' C] step = -gradient`` for D parameters of each of N poses and S shared ones, in that order.

    Rows and columns of parameters that are not free are zero, and so are their steps.
    """

    elimination: Elimination  # of the images by the L links between images that are not fixed
    free: BoolArray  # (N, D)
    poses: FloatArray  # (N, D, D): the blocks of A on its diagonal
    links: FloatArray  # (L, D, D): those of the links: rows of their second image, columns of their first
    coupling: FloatArray  # (N, D, S): B
    shared: FloatArray  # (S, S): C
    gradient_poses: FloatArray  # gradient_poses, gradient_shared: (N, D) and (S,)
    gradient_shared: FloatArray

    def solve(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """The steps (N, D) and (S,), with the diagonal enlarged by ``1 + damping`` (Marquardt).

        :exc:`numpy.linalg.LinAlgError` where the images determine no step.
        """
        step_poses, step_shared = self._stepped(
            self._factorized(damping),
            self.gradient_poses[..., None],
            self.gradient_shared[:, None],
            np.diag(np.diag(self.shared)) * damping,
        )
        return step_poses[..., 0], step_shared[:, 0]

    def responses(self, gradient_poses: FloatArray, gradient_shared: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The steps, (N, D, C) and (S, C), for C gradients of these shapes in place of the equations' own."""
        return self._stepped(self._least_damped, gradient_poses, gradient_shared)

    def with_priors(
        self,
        precision_poses: FloatArray,
        error_poses: FloatArray,
        information_shared: FloatArray,
        gradient_shared: FloatArray,
    ) -> Self:
        """Add priors: on the poses as inverse variances and distances from the means, both (N, D)."""
        precision = np.where(self.free, precision_poses, 0.0)
        return replace(
            self,
            poses=self.poses + precision[..., None] * np.eye(precision.shape[1]),
            shared=self.shared + information_shared,
            gradient_poses=self.gradient_poses + precision * error_poses,
            gradient_shared=self.gradient_shared + gradient_shared,
        )

    def shared_information(self) -> FloatArray:
        """Information (S, S) on the shared parameters when nothing is known of the poses: ``C - B' A⁻¹ B``.

        Poses that nothing holds are damped as little as makes them solvable; where nothing does, nothing is known.
        """
        for damping in _DAMPINGS:
            try:
                information = self.shared - self._coupled(self._factorized(damping).solve(self.coupling))
            except np.linalg.LinAlgError:
                continue
            if np.isfinite(information).all():
                return information
        return np.zeros_like(self.shared)

    def pose_covariances(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Blocks of the inverse of the whole matrix: each image's with itself, (N, D, D), those with the shared
        parameters (N, D, S), and the one of these (S, S).
        """
        by_shared, of_shared = self.responses(np.zeros_like(self.coupling), -np.eye(len(self.shared)))
        conditional = np.where(self.free[:, :, None] & self.free[:, None], self._least_damped.inverse_diagonal(), 0.0)
        moved = -self._least_damped.solve(self.coupling)  # how poses follow a unit step of each shared parameter
        return conditional + by_shared @ moved.swapaxes(1, 2), by_shared, of_shared

    def _coupled(self, poses: FloatArray) -> FloatArray:
        """``B' x`` (S, C) of some (N, D, C)."""
        rows = self.coupling.shape[0] * self.coupling.shape[1]
        return self.coupling.reshape(rows, -1).T @ poses.reshape(rows, -1)

    def _stepped(
        self, factors: BlockCholesky, poses: FloatArray, shared: FloatArray, added: FloatArray | float = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """The steps for gradients (N, D, C) and (S, C), by the factors of A and with something added to C."""
        size = len(self.shared)
        solved = factors.solve(np.concatenate([self.coupling, np.where(self.free[..., None], poses, 0.0)], axis=2))
        by_shared, alone = solved[..., :size], solved[..., size:]
        step = _solve_scaled(self.shared - self._coupled(by_shared) + added, self._coupled(alone) - shared)
        return -alone - by_shared @ step, step

    @cached_property
    def _least_damped(self) -> BlockCholesky:
        """The factors that all responses have in common."""
        for damping in _DAMPINGS[1:-1]:
            with suppress(np.linalg.LinAlgError):
                return self._factorized(damping)
        return self._factorized(_DAMPINGS[-1])

    def _factorized(self, damping: float) -> BlockCholesky:
        diagonal = np.einsum("ndd->nd", self.poses)
        floor = max(float(diagonal.max()), 1e-300) * 1e-14
        added = np.where(self.free, damping * diagonal + floor, 1.0)
        return self.elimination.factorized(self.poses + added[..., None] * np.eye(added.shape[1]), self.links)


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


@dataclass(frozen=True, eq=False)
class Structure:
    """Which images the links couple: the same at every step."""

    free: BoolArray  # (N, D): parameters of the poses that are estimated
    joined: BoolArray  # (L,): links between images that are not fixed
    elimination: Elimination  # of the images by these links
    # some links at a time; of their first and of their second images which these are, and what sums over each one's
    sums: tuple[tuple[slice, tuple[tuple[IntArray, "sparse.csr_array"], ...]], ...]

    @classmethod
    def of(cls, observations: Observations, free: BoolArray) -> Self:
        """By the images of the links."""
        image1, image2, moving = observations.image1, observations.image2, np.asarray(free.any(axis=1))
        joined = moving[image1] & moving[image2]
        starts = range(0, len(observations), _LINKS_AT_ONCE)
        parts = [slice(first, min(first + _LINKS_AT_ONCE, len(observations))) for first in starts]
        sums = tuple((links, (_sums(image1[links]), _sums(image2[links]))) for links in parts)
        return cls(free, joined, Elimination.of_links(len(free), image1[joined], image2[joined]), sums)


def _sums(images: IntArray) -> tuple[IntArray, "sparse.csr_array"]:
    """The images of some links (l,), each once, and the matrix that sums rows of the links for each of them."""
    order = np.argsort(images, kind="stable")
    present, first = np.unique(images[order], return_index=True)
    shape = len(present), len(images)
    return present, sparse.csr_array((np.ones(len(images)), order, np.append(first, len(images))), shape)


def assemble(
    equations: LinkEquations,
    observations: Observations,
    model: ModelMatrices,
    homographies: FloatArray,
    structure: Structure,
    weight: float,
    marks: ImageEquations | None = None,
) -> SparseNormalEquations:
    """Chain the equations of the links with the derivatives of the model, whose shared parameters the lens follows.

    The homographies are those of the links (L, 3, 3), the weight is one over the variance of the errors; what
    ``marks`` in single images show comes besides.
    """
    size, others = model.by_pose.shape[1], model.by_shared.shape[1] + equations.gram.shape[1] - 9
    free, pair = structure.free, 2 * size
    by_image = np.zeros((len(free), size * (size + others + 1)))
    of_links = np.empty((len(observations), size, size))
    shared, gradient_shared = np.zeros((others, others)), np.zeros(others)
    for links, (sums1, sums2) in structure.sums:
        derivative = link_derivatives(observations, model, homographies, equations.gram.shape[1] - 9, links)
        local = np.swapaxes(derivative, 1, 2) @ equations.gram[links] @ derivative * weight
        gradient = np.einsum("lpk,lp->lk", derivative, equations.gradient[links]) * weight
        if marks is not None:
            marks.add_to(local, gradient, observations, links)
        images = observations.image1[links], observations.image2[links]
        moving = np.concatenate([free[images[0]], free[images[1]], np.ones((len(local), others))], axis=1)
        local, gradient = local * moving[:, :, None] * moving[:, None, :], gradient * moving
        of_links[links] = local[:, size:pair, :size]
        for (present, sums), of_pose in ((sums1, slice(size)), (sums2, slice(size, pair))):
            # One row for each image: its block, its rows of the coupling, and its gradient.
            rows = np.concatenate(
                [local[:, of_pose, of_pose], local[:, of_pose, pair:], gradient[:, of_pose, None]], axis=2
            )
            by_image[present] += sums @ rows.reshape(len(rows), -1)
        shared += local[:, pair:, pair:].sum(axis=0)
        gradient_shared += gradient[:, pair:].sum(axis=0)
    blocks = by_image.reshape(len(free), size, -1)
    poses, coupling, gradient_poses = np.split(blocks, [size, size + others], axis=2)
    of_joined = of_links[structure.joined]
    return SparseNormalEquations(
        structure.elimination, free, poses, of_joined, coupling, shared, gradient_poses[:, :, 0], gradient_shared
    )


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
