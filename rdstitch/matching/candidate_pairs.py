"""Which pairs of pictures to match, so that the cost does not grow with the square of their number.

Up to :data:`EXHAUSTIVE_UP_TO` pictures every pair is compared. Beyond, pictures that follow one another and pictures
that look alike. Of these, each picture is registered with those that matter for its place; and once poses are known,
with those that the poses put beside it and that close a loop.
"""

import warnings
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Protocol, TypeVar

import numpy as np
from scipy.spatial import KDTree

from rdstitch.arrays import FloatArray
from rdstitch.camera import Camera
from rdstitch.features import Features
from rdstitch.radial_homography import to_plane

EXHAUSTIVE_UP_TO = 30
"""Number of pictures up to which every pair is tried."""

_FOLLOWING = 3  # pictures after each one that are tried
_LOOKALIKES = 6  # pictures that look most alike that are tried for each one
_NEIGHBOURS = 10  # nearest pictures in the plane that are considered for each one
_LEAST_OVERLAP = 0.15  # share of the smaller footprint
_PARTNERS = 6  # pairs of a picture that its place is found by; those that others choose come on top
_CELLS_ASIDE = 4  # cells of a picture, a side, that its partners are to cover
_WORDS = 64
_TRAINING = 20000  # descriptors that the words are learned from
_DESCRIBING = 1000  # strongest features that describe a picture

Pairs = list[tuple[int, int]]

Shared = TypeVar("Shared", bound="PointsOfTwo")


class PointsOfTwo(Protocol):
    """Places of matches in the two images of a pair, pixels (M, 2)."""

    @property
    def points1(self) -> FloatArray:
        """In the first."""
        ...

    @property
    def points2(self) -> FloatArray:
        """In the second."""
        ...


def first_pairs(features: Sequence[Features], seed: int) -> Pairs:
    """Pairs (i, j), i < j, to try before anything is known of the poses.

    Parameters
    ----------
    features : sequence of Features
        One a picture, in the order in which the pictures were taken, if there is one.
    seed : int
    """
    count = len(features)
    if count <= EXHAUSTIVE_UP_TO:
        return list(combinations(range(count), 2))
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + _FOLLOWING, count))}
    return sorted(pairs | lookalikes(features, seed))


def lookalikes(features: Sequence[Features], seed: int) -> set[tuple[int, int]]:
    """Pairs of pictures whose features are most alike, by vectors of locally aggregated descriptors (VLAD).

    Each picture's descriptors are assigned to the nearest of a few words, learned from the pictures themselves; the
    residuals are added up per word, square-rooted, normalized per word and as a whole (Arandjelović and Zisserman
    2013). One matrix product then compares all pictures.
    """
    counts = np.array([min(len(found), _DESCRIBING) for found in features])
    total = int(counts.sum())
    if total < _WORDS * 10:
        return set()
    random = np.random.default_rng([seed, 2])
    chosen = np.sort(random.choice(total, min(_TRAINING, total), replace=False))
    starts = np.cumsum(counts) - counts
    own = np.split(chosen, np.searchsorted(chosen, starts[1:]))
    training = np.concatenate(
        [_describing(found)[part - start] for found, part, start in zip(features, own, starts, strict=True)]
    )
    # Imported late: only large sets need it.
    from scipy.cluster.vq import kmeans2

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a word that no descriptor is nearest to does no harm
        words, _ = kmeans2(training, _WORDS, iter=8, minit="points", rng=random)
    vectors = np.stack([_aggregate(_describing(found), words) for found in features])
    alike = vectors @ vectors.T
    np.fill_diagonal(alike, -np.inf)
    best = np.argsort(-alike, axis=1, kind="stable")[:, :_LOOKALIKES]
    return {(min(i, j), max(i, j)) for i, row in enumerate(best.tolist()) for j in row if len(features[i])}


def pairs_that_matter(
    shared: Mapping[tuple[int, int], Shared], cameras: Sequence[Camera]
) -> dict[tuple[int, int], Shared]:
    """Of pairs that share something those that one of their images needs for its place.

    An image takes one partner after the other: the one whose matches add most to the sum of the square roots of the
    numbers of matches in its cells. So partners with many matches come first, but rather around the image than
    all on one side of it. Of a survey in which each image overlaps twenty others, a third of the pairs is left.

    Parameters
    ----------
    shared : mapping of (int, int) to Shared
        Some matches of each pair (i, j).
    cameras : sequence of Camera
        One an image; only their sizes are used.
    """
    partners: dict[int, list[tuple[tuple[int, int], FloatArray]]] = {}
    for pair, found in shared.items():
        for image, points in zip(pair, (found.points1, found.points2), strict=True):
            cell = np.clip(points / cameras[image].image_size * _CELLS_ASIDE, 0, _CELLS_ASIDE - 1).astype(np.intp)
            counts = np.bincount(cell @ [1, _CELLS_ASIDE], minlength=_CELLS_ASIDE**2)
            partners.setdefault(image, []).append((pair, counts.astype(np.float64)))
    chosen: set[tuple[int, int]] = set()
    for own in partners.values():
        counts, covered = np.array([cells for _, cells in own]), np.zeros(_CELLS_ASIDE**2)
        for _ in range(min(_PARTNERS, len(own))):
            best = int(np.sqrt(covered + counts).sum(axis=1).argmax())
            chosen.add(own[best][0])
            covered, counts[best] = covered + counts[best], 0.0
    return {pair: found for pair, found in shared.items() if pair in chosen}


def neighbours(cameras: Sequence[Camera], homographies: FloatArray, tried: set[tuple[int, int]]) -> Pairs:
    """Pairs that the poses put over one another and that were not tried yet, where the match graph needs them.

    It does not need a pair of images that both have their partners, one of them in common: that closes no loop.

    Parameters
    ----------
    cameras : sequence of Camera
    homographies : ndarray of shape (N, 3, 3)
        From undistorted normalized coordinates of each picture to the plane; NaN for pictures without a pose.
    tried : set of (int, int)
        Pairs (i, j), i < j.
    """
    footprints = np.array([_footprint(*placed) for placed in zip(cameras, homographies, strict=True)])
    known = np.flatnonzero(np.isfinite(footprints).all(axis=(1, 2))).tolist()
    if len(known) < 2:
        return []
    boxes = footprints[known]
    centres = boxes.mean(axis=1)
    nearest = KDTree(centres).query(centres, k=min(_NEIGHBOURS + 1, len(known)))[1].reshape(len(known), -1)
    partners: dict[int, set[int]] = {}
    for i, j in tried:
        partners.setdefault(i, set()).add(j)
        partners.setdefault(j, set()).add(i)

    def needed(i: int, j: int) -> bool:
        first, second = partners.get(i, set()), partners.get(j, set())
        return min(len(first), len(second)) < _PARTNERS or not first & second

    found = set()
    for a, row in enumerate(nearest.tolist()):
        for b in row:
            pair = (known[min(a, b)], known[max(a, b)])
            if a == b or pair in tried or not needed(*pair):
                continue
            if _overlap(boxes[a], boxes[b]) >= _LEAST_OVERLAP:
                found.add(pair)
    return sorted(found)


def _describing(features: Features) -> FloatArray:
    """The descriptors that stand for a picture."""
    descriptors = features.descriptors[:_DESCRIBING]
    return (np.unpackbits(descriptors.astype(np.uint8), axis=1) if features.binary else descriptors).astype(np.float64)


def _aggregate(descriptors: FloatArray, words: FloatArray) -> FloatArray:
    """One unit vector of a picture's descriptors."""
    distances = (words**2).sum(axis=1) - 2.0 * descriptors @ words.T
    nearest = distances.argmin(axis=1)
    sums = np.zeros_like(words)
    np.add.at(sums, nearest, descriptors - words[nearest])
    sums = np.sign(sums) * np.sqrt(np.abs(sums))
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    vector = sums.ravel()
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))


def _footprint(camera: Camera, homography: FloatArray) -> FloatArray:
    """Lower and upper bounds (2, 2) of a picture in the plane; NaN where the horizon crosses it."""
    plane = to_plane(camera, homography, camera.outline(8))
    return np.stack([plane.min(axis=0), plane.max(axis=0)])


def _overlap(box1: FloatArray, box2: FloatArray) -> float:
    """Area that two boxes share, relative to the smaller one."""
    common = np.minimum(box1[1], box2[1]) - np.maximum(box1[0], box2[0])
    if (common <= 0.0).any():
        return 0.0
    return float(common.prod() / min(np.ptp(box1, axis=0).prod(), np.ptp(box2, axis=0).prod()))
