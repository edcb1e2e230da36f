"""Which images look alike: a vocabulary of the folder's own descriptors, and words in common.

Every descriptor is replaced by the nearest of up to 65,536 words, learned from a sample of the images' descriptors as
a tree of two levels (Nistér and Stewénius 2006). Two images are alike as far as they share words, rare ones above all
(TF-IDF; Sivic and Zisserman 2003). The cost grows with the number of images; only a product of sparse matrices with
their square, of which 10,000 images take seconds.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.features import Features
from rdstitch.matching.feature_store import FeatureStore
from rdstitch.system.late_imports import sparse

_FEATURES_PER_IMAGE = 1000  # strongest features that describe an image
_DESCRIPTORS_PER_WORD = 16  # few enough that a word is rare, enough that one place on the ground is one word
_MAX_WORDS = 65_536
_MIN_DESCRIPTORS = 640  # fewer are no vocabulary
_TRAINING_PER_WORD = 5  # descriptors that words are learned from
_TRAINING_PER_BRANCH = 50
_ROUNDS = 3  # of Lloyd's algorithm
_SHORTLIST = 40  # most similar images of each that are considered further
_SHARED_NEIGHBOURS = 10  # most similar images of each that two images may have in common
# Fraction of the other images that are less alike than the next one where the order means something.
_SEQUENCE_RANK = 0.75
_MIN_SEQUENTIAL_FRACTION = 0.5  # fraction of the images of which that is true of the next one; a quarter by chance
_BLOCK = 8192  # descriptors assigned at a time
_ROWS = 256  # images compared with all others at a time
_LARGEST = 65504.0  # in half precision

Array32 = NDArray[np.float32]
Descriptors = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class Similarity:
    """How alike N images are, as far as they are."""

    scores: "sparse.csr_array"  # symmetric; larger is more alike, and what any two images have in common counts nothing
    most_alike: IntArray  # (N, K), intp: the K other images that are most alike to each, the most alike first
    ordered: bool  # whether images that follow one another are alike, so that their order means something


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """Words in a tree of two levels."""

    branches: Array32  # (B, D), float32
    words: Array32  # (B, B, D), float32: of each branch

    @classmethod
    def learned(cls, descriptors: Descriptors, branches: int, random: np.random.Generator) -> "Vocabulary":
        """Words that the descriptors (M, D), more than ``branches``, fall into; of any type, made float32 in parts."""
        few = np.sort(random.choice(len(descriptors), min(_TRAINING_PER_BRANCH * branches, len(descriptors)), False))
        top = _lloyd(descriptors[few].astype(np.float32), branches, random)
        words = np.repeat(top[:, None], branches, axis=1)
        nearest = _nearest(descriptors, top)
        for branch in range(branches):
            members = descriptors[nearest == branch].astype(np.float32)
            if len(members):
                centres = _lloyd(members, min(branches, len(members)), random)
                words[branch, : len(centres)] = centres
        return cls(top, words)

    @property
    def size(self) -> int:
        """Number of words."""
        return len(self.branches) ** 2

    def assign(self, descriptors: Array32) -> NDArray[np.int32]:
        """The word of each descriptor, shape (M,)."""
        word = np.empty(len(descriptors), dtype=np.int32)
        branch = _nearest(descriptors, self.branches)
        order = np.argsort(branch, kind="stable")
        edges = np.searchsorted(branch[order], np.arange(len(self.branches) + 1))
        for k in np.flatnonzero(np.diff(edges)).tolist():
            rows = order[edges[k] : edges[k + 1]]
            word[rows] = k * len(self.branches) + _nearest(descriptors[rows], self.words[k])
        return word


def similarity(features: FeatureStore, seed: int) -> Similarity | None:
    """How alike the images are whose features these are; None where they show too little to say.

    ``features``: one an image, in the order in which the images were taken, if there is one; read twice, one at a time.
    """
    counts = np.minimum(features.counts, _FEATURES_PER_IMAGE)
    total = int(counts.sum())
    if total < _MIN_DESCRIPTORS:
        return None
    random = np.random.default_rng([seed, 2])
    branches = int(np.sqrt(min(total / _DESCRIPTORS_PER_WORD, _MAX_WORDS)))
    wanted = min(_TRAINING_PER_WORD * branches**2, total)
    chosen = np.sort(random.choice(total, wanted, replace=False))
    starts = np.cumsum(counts) - counts
    parts = np.split(chosen, np.searchsorted(chosen, starts[1:]))
    vocabulary = Vocabulary.learned(_training(features, parts, starts), branches, random)
    words = np.concatenate([*map(vocabulary.assign, _in_blocks(map(_describing, features)))])
    shape = len(counts), vocabulary.size
    used = sparse.csr_array((np.ones(total, dtype=np.float32), words, np.append(starts, total)), shape)
    used.sum_duplicates()
    rarity = np.log(len(counts) / np.maximum(np.bincount(used.indices, minlength=vocabulary.size), 1))
    weighted = (used @ sparse.diags_array(rarity.astype(np.float32))).tocsr()
    return _compare(_unit_rows(weighted))


def _training(features: FeatureStore, parts: list[IntArray], starts: IntArray) -> NDArray[np.float16]:
    """The descriptors that words are learned from, by their places among those of all images.

    Half precision loses nothing of descriptors as they are stored, and single precision would be the largest array of a
    run.
    """
    sample, filled = np.empty((0, 0), dtype=np.float16), 0
    for of_image, part, start in zip(features, parts, starts, strict=True):
        chosen = _describing(of_image)[part - start]
        if not sample.size:
            sample = np.empty((sum(map(len, parts)), chosen.shape[1]), dtype=np.float16)
        sample[filled : filled + len(chosen)] = np.clip(chosen, -_LARGEST, _LARGEST)
        filled += len(chosen)
    return sample


def _describing(features: Features) -> Array32:
    """The descriptors that stand for an image."""
    descriptors = features.descriptors[:_FEATURES_PER_IMAGE]
    return (np.unpackbits(descriptors.astype(np.uint8), axis=1) if features.binary else descriptors).astype(np.float32)


def _in_blocks(of_images: Iterator[Array32]) -> Iterator[Array32]:
    """The descriptors of several images at once: few of each image are near the same words."""
    while images := list(islice(of_images, _BLOCK // _FEATURES_PER_IMAGE)):
        yield np.concatenate([one for one in images if len(one)] or images[:1])


def _compare(weights: "sparse.csr_array") -> Similarity:
    """Compare all images by their words, unit vectors (N, words), zero without features; some rows at a time."""
    count = weights.shape[0]
    kept = min(_SHORTLIST, count - 1)
    best, values = np.empty((count, kept), dtype=np.intp), np.empty((count, kept))
    usual, next_one = np.empty(count), np.zeros(count, dtype=np.bool_)
    across = weights.T.tocsr()
    for first in range(0, count, _ROWS):
        rows = np.arange(first, min(first + _ROWS, count))
        alike = np.asarray((weights[rows] @ across).todense(), dtype=np.float64)
        usual[rows], high = np.quantile(alike, (0.5, _SEQUENCE_RANK), axis=1)
        following = alike[np.arange(len(rows)), np.minimum(rows + 1, count - 1)]
        next_one[rows] = following > high
        alike[np.arange(len(rows)), rows] = -1.0
        nearest = np.sort(np.argpartition(-alike, kept - 1, axis=1)[:, :kept], axis=1)
        of_nearest = np.take_along_axis(alike, nearest, axis=1)
        order = np.argsort(-of_nearest, axis=1, kind="stable")
        best[rows], values[rows] = (np.take_along_axis(one, order, axis=1) for one in (nearest, of_nearest))
    excess = np.maximum(values - (usual[:, None] + usual[best]) / 2.0, 0.0)
    ordered = bool(next_one[:-1].mean() > _MIN_SEQUENTIAL_FRACTION)
    # Raised where images are alike to the same others: all neighbours in common count as the usual best similarity.
    neighbours = _unit_rows(_symmetric(best[:, :_SHARED_NEIGHBOURS], excess[:, :_SHARED_NEIGHBOURS]))
    scores = _symmetric(best, excess) + float(np.mean(excess[:, 0])) * (neighbours @ neighbours.T)
    return Similarity(sparse.csr_array(scores), best, ordered)


def _symmetric(columns: IntArray, values: FloatArray) -> "sparse.csr_array":
    """Sparse matrix (N, N) of the values (N, K) at the columns (N, K), or those mirrored, whichever is larger."""
    count, kept = columns.shape
    rows = np.repeat(np.arange(count), kept)
    matrix = sparse.coo_array((values.ravel(), (rows, columns.ravel())), shape=(count, count)).tocsr()
    return sparse.csr_array(matrix.maximum(matrix.T))


def _unit_rows(matrix: "sparse.csr_array") -> "sparse.csr_array":
    """Scale rows to length one; those of zeros stay."""
    length = np.sqrt(np.asarray(matrix.multiply(matrix).sum(axis=1)).ravel())
    return sparse.csr_array(sparse.diags_array((1.0 / np.maximum(length, 1e-12)).astype(matrix.dtype)) @ matrix)


def _lloyd(points: Array32, count: int, random: np.random.Generator) -> Array32:
    """Centres (count, D) of clusters of the points (M, D)."""
    centres = points[np.sort(random.choice(len(points), count, replace=False))]
    for _ in range(_ROUNDS):
        nearest = _nearest(points, centres)
        sizes = np.bincount(nearest, minlength=count)
        members = sparse.csr_array(
            (np.ones(len(points), dtype=np.float32), (nearest, np.arange(len(points)))), shape=(count, len(points))
        )
        means = (members @ points) / np.maximum(sizes, 1)[:, None].astype(np.float32)
        centres = np.where(sizes[:, None] > 0, means, centres)
    return centres


def _nearest(points: Descriptors, centres: Array32) -> IntArray:
    """The nearest centre of each point, shape (M,)."""
    half = np.einsum("kd,kd->k", centres, centres) / 2.0
    nearest = np.empty(len(points), dtype=np.intp)
    for first in range(0, len(points), _BLOCK):
        part = slice(first, first + _BLOCK)
        nearest[part] = (points[part].astype(np.float32, copy=False) @ centres.T - half).argmax(axis=1)
    return nearest
