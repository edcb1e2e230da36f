"""Matching: mutual nearest neighbours that pass the ratio test, exactly, by blocked matrix products."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rdstitch.camera import FloatArray
from rdstitch.errors import ArgumentError
from rdstitch.features.keypoints import Features

_DEFAULT_RATIO = 0.85
_BLOCK_BYTES = 2**24
_NORM = (
    1024.0  # largest norm of scaled descriptors: all sums of products of integers then fit float32's 24 bits
)


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Points of two pictures that show the same, the most distinctive match first (PROSAC's order).

    Attributes
    ----------
    indices : ndarray of shape (M, 2), intp
        Indices into the features of picture 1 and picture 2.
    points1, points2 : ndarray of shape (M, 2), float64
        px of the full-size pictures.
    ratio : ndarray of shape (M,), float64
        Distance to the match over distance to the second-best, the worse of both directions; in [0, 1],
        ascending.

    Raises
    ------
    ArgumentError
        When the shapes do not fit together.
    """

    indices: NDArray[np.intp]
    points1: FloatArray
    points2: FloatArray
    ratio: FloatArray

    def __post_init__(self) -> None:
        """Check shapes."""
        count = len(self.ratio)
        shapes = (self.indices.shape, self.points1.shape, self.points2.shape, self.ratio.shape)
        if shapes != ((count, 2), (count, 2), (count, 2), (count,)):
            raise ArgumentError(f"correspondences of different lengths: {shapes}")

    def __len__(self) -> int:
        """Number of correspondences."""
        return len(self.ratio)


def match(
    features1: Features, features2: Features, ratio: float | None = None, block_bytes: int = _BLOCK_BYTES
) -> Correspondences:
    """Match the features of two pictures.

    A match is the nearest neighbour in both directions, and in both directions nearer than ``ratio`` times the
    second nearest. Exchanging the pictures exchanges the columns of the result. A tie for the nearest is no
    match.

    Descriptors are compared as integers (as they are for SIFT, as bits for binary ones, else rounded to 1/1024
    of the largest norm), for which products summed in float32 are exact: the result depends neither on the size
    of blocks nor on the threads of the BLAS.

    Parameters
    ----------
    features1, features2 : Features
        Of the same kind.
    ratio : float, optional
        Largest ratio of distances, in (0, 1].
    block_bytes : int
        Memory for one block of distances, bytes.

    Raises
    ------
    ArgumentError
        When the kinds differ or ``ratio`` is out of range.
    """
    limit = _DEFAULT_RATIO if ratio is None else ratio
    if not 0 < limit <= 1:
        raise ArgumentError(f"ratio must be in (0, 1], not {limit}")
    if features1.kind != features2.kind:
        raise ArgumentError(
            f"features of different kinds do not match: {features1.kind} and {features2.kind}"
        )
    pairs, ratios = _match_signs(features1, features2, block_bytes)
    passed = ratios < limit if limit < 1 else np.ones(len(ratios), dtype=bool)
    pairs, ratios = pairs[passed], ratios[passed]
    order = np.lexsort((pairs[:, 0], ratios))
    pairs, ratios = pairs[order], ratios[order]
    return Correspondences(pairs, features1.points[pairs[:, 0]], features2.points[pairs[:, 1]], ratios)


def _match_signs(
    features1: Features, features2: Features, block_bytes: int
) -> tuple[NDArray[np.intp], FloatArray]:
    """Mutual matches and their ratios, between features of equal sign of the Laplacian if they have one."""
    sign1, sign2 = features1.laplacian_sign, features2.laplacian_sign
    values1, values2 = _as_integers(features1, features2)
    if sign1 is None or sign2 is None:
        return _mutual(values1, values2, features1.binary, block_bytes)
    parts = []
    for sign in (-1, 1):
        index1, index2 = np.flatnonzero(sign1 == sign), np.flatnonzero(sign2 == sign)
        pairs, ratios = _mutual(values1[index1], values2[index2], features1.binary, block_bytes)
        parts.append((np.column_stack([index1[pairs[:, 0]], index2[pairs[:, 1]]]), ratios))
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def _as_integers(features1: Features, features2: Features) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Descriptors as integers in float32, so small that squared distances are exact."""
    if features1.binary:
        bits = [np.unpackbits(np.asarray(f.descriptors, np.uint8), axis=1) for f in (features1, features2)]
        return bits[0].astype(np.float32), bits[1].astype(np.float32)
    both = [np.asarray(f.descriptors, np.float32) for f in (features1, features2)]
    norm = max((float(np.linalg.norm(d, axis=1).max(initial=0.0)) for d in both), default=0.0)
    # A power of two leaves integers what they are.
    scale = np.float32(2.0 ** np.floor(np.log2(_NORM / norm)) if norm > 0 else 1.0)
    return np.rint(both[0] * scale), np.rint(both[1] * scale)


def _mutual(
    values1: NDArray[np.float32], values2: NDArray[np.float32], binary: bool, block_bytes: int
) -> tuple[NDArray[np.intp], FloatArray]:
    """Mutual nearest neighbours, and the worse of both ratios of distances, for integer descriptors.

    One matrix product gives ``-d²/2`` of a block of features 1 to all features 2: the descriptors carry
    ``(…, 1, -n²/2)`` and ``(…, -n²/2, 1)``.
    """
    count1, count2 = len(values1), len(values2)
    if count1 == 0 or count2 == 0:
        return np.zeros((0, 2), dtype=np.intp), np.zeros(0)
    half1, half2 = (np.einsum("ij,ij->i", v, v)[:, None] / np.float32(2) for v in (values1, values2))
    left = np.hstack([values1, np.ones_like(half1), -half1])
    right = np.hstack([values2, -half2, np.ones_like(half2)]).T
    nearest = np.empty(count1, dtype=np.intp)
    best_row, second_row = np.empty((2, count1), dtype=np.float32)
    best_column, second_column = np.full((2, count2), -np.inf, dtype=np.float32)
    rows = max(1, block_bytes // (4 * count2))
    for start in range(0, count1, rows):
        block = left[start : start + rows] @ right
        here = slice(start, start + len(block))
        for row in block:
            np.maximum(second_column, np.minimum(best_column, row), out=second_column)
            np.maximum(best_column, row, out=best_column)
        index = np.arange(len(block))
        nearest[here] = best = block.argmax(axis=1)
        best_row[here] = block[index, best]
        block[index, best] = -np.inf
        second_row[here] = block.max(axis=1)
    # A tie leaves second == best in one of the directions.
    unique = (best_row > second_row) & (best_row == best_column[nearest])
    unique &= best_column[nearest] > second_column[nearest]
    first = np.flatnonzero(unique)
    second = nearest[first]
    distance2 = -2.0 * best_row[first].astype(np.float64)
    runner_up = -2.0 * np.maximum(second_row[first], second_column[second]).astype(np.float64)
    quotient = distance2 / runner_up
    return np.column_stack([first, second]), quotient if binary else np.sqrt(quotient)
