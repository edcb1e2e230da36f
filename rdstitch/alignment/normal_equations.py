"""Normal equations of the adjustment: one small Gram matrix per link, chained into sparse blocks.

A correspondence depends on the homography of its link (9 entries) and the lens (5 parameters) only. So all it
contributes is summed up in a 14x14 matrix per link, whatever the motion model; the model's derivatives then turn
that matrix into the blocks of its two pictures and of the shared parameters.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from rdstitch.alignment.motion_models import ModelMatrices, inverses
from rdstitch.alignment.observations import Observations
from rdstitch.alignment.pose_blocks import PoseBlocks
from rdstitch.arrays import BoolArray, FloatArray
from rdstitch.camera import LENS_PARAMETERS
from rdstitch.division_model import is_one_to_one
from rdstitch.radial_homography import (
    measurement_whitening,
    points_last,
    side_by_side,
    transfer_jacobian,
    whiten,
)
from rdstitch.robust.loss import robust_weight

_CHUNK = 4096
"""Correspondences linearized at a time: what stays in cache."""


_ENTRIES = 9 + len(LENS_PARAMETERS)
"""Of the homography of a link, and of the lens."""


@dataclass(frozen=True)
class LinkEquations:
    """Weighted, linearized transfer errors of all correspondences, summed per link.

    Attributes
    ----------
    gram : ndarray of shape (L, 14, 14)
        ``Σ w J'J`` by the entries of H and the lens parameters.
    gradient : ndarray of shape (L, 14)
        ``Σ w J'r``.
    squared : ndarray of shape (M,)
        ``|r|²`` of each correspondence, px², whitened; inf where it cannot be transferred.
    whitening : ndarray of shape (M, 2, 2)
        What makes r of an error in normalized coordinates.
    error : ndarray of shape (M, 2)
        That error; not finite where it cannot be transferred.
    """

    gram: FloatArray
    gradient: FloatArray
    squared: FloatArray
    whitening: FloatArray
    error: FloatArray

    @np.errstate(all="ignore")
    def squared_with(self, whitening: FloatArray) -> FloatArray:
        """``|r|²`` (M,) with a whitening that was computed elsewhere, px²; inf where there is no transfer.

        Between one linearization and the next the whitening must stay what it is: otherwise the errors could be made
        smaller by a larger derivative, against the gradient, which takes the whitening for constant.
        """
        r = whiten(whitening, self.error[:, :, None])[:, :, 0]
        squared = np.einsum("mi,mi->m", r, r)
        return np.where(np.isfinite(squared), squared, np.inf)


def split_lens(lens: FloatArray) -> tuple[float, tuple[float, ...], FloatArray]:
    """λ; μ and ν, nothing where both are 0; and the distortion centre (2,), of :data:`LENS_PARAMETERS` (5,)."""
    distortion, *higher = lens[:3].tolist()
    return distortion, tuple(higher) if any(higher) else (), lens[3:]


def folds(lens: FloatArray, reach: float = 1.0) -> bool:
    """Whether a lens with more than λ would show a place twice, out to a radius in half diagonals."""
    distortion, higher, center = split_lens(lens)
    return bool(higher) and not is_one_to_one(reach + float(np.linalg.norm(center)), (distortion, *higher))


@np.errstate(all="ignore")  # a long step may give homographies that are not finite
def link_equations(
    observations: Observations, homographies: FloatArray, lens: FloatArray, width: float
) -> LinkEquations:
    """Linearize all transfer errors.

    Parameters
    ----------
    observations : Observations
    homographies : ndarray of shape (L, 3, 3)
        Of each link, from its first to its second picture.
    lens : ndarray of shape (5,)
        λ, μ, ν and the shift of the distortion centre, in the half-diagonal frame.
    width : float
        Of :func:`robust_weight`, pixels.
    """
    count = len(observations)
    gram, gradient = np.zeros((count, _ENTRIES, _ENTRIES)), np.zeros((count, _ENTRIES))
    squared = np.empty(len(observations.points1))
    whitening, errors = np.empty((len(observations.points1), 2, 2)), np.empty((len(observations.points1), 2))
    for first, last in _chunks(observations.start):
        rows = slice(observations.start[first], observations.start[last])
        jacobian, error, whitening[rows], errors[rows] = _whitened(observations, homographies, lens, first, last)
        squared[rows] = np.einsum("mi,mi->m", error, error)
        lost = ~np.isfinite(squared[rows])
        squared[rows][lost] = np.inf
        jacobian[lost], error[lost] = 0.0, 0.0
        root = np.sqrt(robust_weight(squared[rows], width))
        jacobian *= root[:, None, None]
        error *= root[:, None]
        edges = observations.start[first : last + 1] - observations.start[first]
        columns = points_last(jacobian)
        gram[first:last], gradient[first:last] = _link_sums(columns, error, edges)
    return LinkEquations(gram, gradient, squared, whitening, errors)


def _link_sums(columns: FloatArray, error: FloatArray, edges: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
    """``J'J`` (l, 14, 14) and ``J'r`` (l, 14) of links, whose correspondences lie between the edges (l + 1,)."""
    counts = np.diff(edges)
    gram, gradient = np.zeros((len(counts), len(columns[0]), len(columns[0]))), np.zeros((len(counts), len(columns[0])))
    for count in np.unique(counts).tolist():
        links = np.flatnonzero(counts == count)
        rows = edges[links][:, None] + np.arange(count)
        for axis in range(2):
            own = columns[axis][:, rows].swapaxes(0, 1)
            gram[links] += own @ own.swapaxes(1, 2)
            gradient[links] += np.einsum("lpm,lm->lp", own, error[:, axis][rows])
    return gram, gradient


def whitened_errors(observations: Observations, homographies: FloatArray, lens: FloatArray) -> FloatArray:
    """Whitened transfer errors of all correspondences, pixels, shape (M, 2); NaN where there is none."""
    errors = [_whitened(observations, homographies, lens, *chunk)[1] for chunk in _chunks(observations.start)]
    return np.concatenate([np.empty((0, 2)), *errors])


def _chunks(start: NDArray[np.intp]) -> list[tuple[int, int]]:
    """Ranges of links with about :data:`_CHUNK` correspondences each."""
    edges = np.unique(np.searchsorted(start, np.arange(0, start[-1] + _CHUNK, _CHUNK)).clip(max=len(start) - 1))
    return list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))


@np.errstate(all="ignore")
def _whitened(
    observations: Observations, homographies: FloatArray, lens: FloatArray, first: int, last: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Jacobian (m, 2, 14) and error (m, 2) of the correspondences of some links, whitened, pixels.

    Then the whitening, and the error as it is without.
    """
    rows = slice(observations.start[first], observations.start[last])
    counts = np.diff(observations.start[first : last + 1])
    scale1 = np.repeat(observations.scale1[first:last], counts)[:, None, None]
    scale2 = np.repeat(observations.scale2[first:last], counts)[:, None, None]
    homography = np.repeat(homographies[first:last], counts, axis=0)
    distortion, higher, center = split_lens(lens)
    result = transfer_jacobian(homography, distortion, observations.points1[rows] - center, higher)
    whitening = measurement_whitening(result.by_point * (scale2 / scale1)) * scale2
    jacobian = side_by_side(result.by_homography, result.by_lens)
    error = result.points - (observations.points2[rows] - center)
    return whiten(whitening, jacobian), whiten(whitening, error[:, :, None])[:, :, 0], whitening, error


@dataclass(frozen=True)
class SparseNormalEquations:
    """``[A B; B' C] step = -gradient`` for poses and shared parameters, in that order.

    Attributes
    ----------
    blocks : PoseBlocks
        The pattern of A.
    poses : sparse array of shape (F, F)
        A, of the F free pose parameters.
    coupling : ndarray of shape (F, S)
        B.
    shared : ndarray of shape (S, S)
        C.
    gradient_poses, gradient_shared : ndarray of shape (F,) and (S,)
    """

    blocks: PoseBlocks
    poses: sparse.csc_array
    coupling: FloatArray
    shared: FloatArray
    gradient_poses: FloatArray
    gradient_shared: FloatArray

    def solve(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """The step of poses and shared parameters, with the diagonal enlarged by ``1 + damping`` (Marquardt)."""
        reduced, solved = self._eliminate(damping)
        diagonal = np.diag(np.diag(self.shared)) * damping
        right = self.coupling.T @ solved[:, -1] - self.gradient_shared
        step_shared = _solve_scaled(reduced + diagonal, right)
        return -solved[:, -1] - solved[:, :-1] @ step_shared, step_shared

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
        response: FloatArray = -self._eliminate(1e-12)[1][:, : self.coupling.shape[1]]
        return response

    def _eliminate(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """The Schur complement (S, S) and ``A⁻¹ [B, gradient]``."""
        right = np.column_stack([self.coupling, self.gradient_poses])
        if self.poses.shape[0] == 0:
            return self.shared, right
        diagonal = self.poses.data[self.blocks.diagonal]
        floor = max(float(diagonal.max()), 1e-300) * 1e-14
        damped = self.blocks.with_diagonal(self.poses, damping * diagonal + floor)
        factor = splu(damped, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        solved = factor.solve(right)
        return self.shared - self.coupling.T @ solved[:, :-1], solved


def _solve_scaled(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Least-norm solution of a small symmetric system, in units in which its diagonal is one."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    kept = values > 1e-12
    inverse = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
    solution: FloatArray = scale * (vectors @ (inverse * (vectors.T @ (scale * right))))
    return solution


def chain(
    equations: LinkEquations,
    observations: Observations,
    model: ModelMatrices,
    homographies: FloatArray,
    blocks: PoseBlocks,
    free_lens: BoolArray,
    weight: float,
) -> SparseNormalEquations:
    """Chain the equations of the links with the derivatives of the model.

    Parameters
    ----------
    equations : LinkEquations
    observations : Observations
    model : ModelMatrices
        Of all N pictures.
    homographies : ndarray of shape (L, 3, 3)
        ``P_j P_i⁻¹`` of each link.
    blocks : PoseBlocks
        Of the pose parameters that may move.
    free_lens : ndarray of shape (5,), bool
        Lens parameters that may move; they follow the model's shared parameters.
    weight : float
        Of all equations: one over the variance of the errors.
    """
    i, j = observations.image1, observations.image2
    size, count = model.by_pose.shape[1], len(observations)
    inverse = inverses(model.matrices)[i][:, None]
    along = homographies[:, None]
    by_parts = [
        -along @ model.by_pose[i] @ inverse,
        model.by_pose[j] @ inverse,
        model.by_shared[j] @ inverse - along @ model.by_shared[i] @ inverse,
    ]
    by_homography = np.concatenate(by_parts, axis=1).reshape(count, -1, 9)
    lens = np.flatnonzero(free_lens)
    width = by_homography.shape[1]
    derivative = np.zeros((count, _ENTRIES, width + len(lens)))
    derivative[:, :9, :width] = np.swapaxes(by_homography, 1, 2)
    derivative[:, 9 + lens, width + np.arange(len(lens))] = 1.0
    local = np.swapaxes(derivative, 1, 2) @ equations.gram @ derivative * weight
    gradient = np.einsum("lpk,lp->lk", derivative, equations.gradient) * weight

    pair = 2 * size
    return SparseNormalEquations(
        blocks,
        blocks.matrix(local[:, :pair, :pair]),
        blocks.sums(local[:, :pair, pair:]),
        local[:, pair:, pair:].sum(axis=0),
        blocks.sums(gradient[:, :pair]),
        gradient[:, pair:].sum(axis=0),
    )
