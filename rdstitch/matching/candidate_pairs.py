"""Which pairs of images to match, so that the cost does not grow with the square of their number.

Up to :data:`EXHAUSTIVE_UP_TO` images every pair is compared. Beyond, images that follow one another, that were
taken near each other, and that look alike. Of these, those that share something by their strongest features alone, and
that matter for the place of an image; and once poses are known, those that the poses put beside it and that close a
loop.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence, Set
from dataclasses import replace
from itertools import combinations, islice

import numpy as np

from rdstitch.arrays import FloatArray, IntArray
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import project
from rdstitch.matching.feature_store import FeatureStore, StoredMatches
from rdstitch.matching.pair_estimator import PairEstimator
from rdstitch.matching.retrieval import Similarity, similarity
from rdstitch.matching.two_view import Pair, PairRegistration
from rdstitch.numerics.nearest_points import nearest_points
from rdstitch.system.late_imports import sparse

EXHAUSTIVE_UP_TO = 30
"""Number of images up to which every pair is tried."""

CANDIDATES = 15
"""Other images that one is compared with, in the mean: the sides and corners of a survey's frame, twice over."""

_SEQUENCE_NEIGHBOURS = 3  # images after each one that are tried
_RETRIEVED = 4  # images most like each one that are tried, whatever the others are like
_NEAREST = 8  # images taken nearest to each one that are tried
_NEIGHBOURS = 10  # nearest images, by their middles, that are considered for each one
_MIN_OVERLAP = 0.15  # fraction of the image of which more is seen in the other
_PLACES_PER_SIDE = 10  # of an image, that are looked up in others
_PARTNERS = 6  # pairs of an image that its place is found by; those that others choose come on top
_CELLS_PER_SIDE = 4  # cells of an image, a side, that its partners are to cover

_PAIRS_AT_ONCE = 1024

_STRONGEST = 500  # features of an image, by which pairs are prescreened
_MIN_MATCHES = 6  # matches among these; images that share nothing have two to five by chance
_MIN_RELATIVE_MATCHES = 0.05  # fraction of the matches that an image has with the one most like it; less adds nothing


def first_pairs(features: FeatureStore, seed: int, positions: FloatArray | None = None) -> list[Pair]:
    """Pairs (i, j), i < j, to try before anything is known of the poses.

    Beyond :data:`EXHAUSTIVE_UP_TO` images, they are images that follow one another where the order means something,
    those taken nearest to each other by ``positions`` (N, 2; NaN where not known), a few that each image is most
    alike to, and those most alike of all, until there are :data:`CANDIDATES` an image in the mean.
    """
    count = len(features)
    if count <= EXHAUSTIVE_UP_TO:
        return list(combinations(range(count), 2))
    alike = similarity(features, seed)
    chosen = set[Pair]()
    if positions is not None and len(known := np.flatnonzero(np.isfinite(positions).all(axis=1))) > 1:
        chosen |= _nearest_pairs(positions[known], known, _NEAREST)
    if alike is None or alike.ordered:
        chosen |= {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + _SEQUENCE_NEIGHBOURS, count))}
    if alike is not None:
        has_features = (features.counts > 0).tolist()
        best = ((i, j) for i, row in enumerate(alike.most_alike[:, :_RETRIEVED].tolist()) for j in row)
        chosen |= {(min(i, j), max(i, j)) for i, j in best if has_features[i] and has_features[j]}
        chosen |= _top_pairs(alike, chosen, CANDIDATES * count // 2)
    return sorted(chosen)


def _top_pairs(alike: Similarity, chosen: set[Pair], total: int) -> set[Pair]:
    """The pairs most alike of all besides those chosen, so many that there are ``total`` of both."""
    scores = sparse.triu(alike.scores, k=1).tocoo()
    best = np.argsort(-scores.data, kind="stable")
    best = best[scores.data[best] > 0.0]
    ranked = zip(scores.row[best].tolist(), scores.col[best].tolist(), strict=True)
    return set(islice((pair for pair in ranked if pair not in chosen), max(total - len(chosen), 0)))


def _nearest_pairs(places: FloatArray, images: IntArray, most: int) -> set[Pair]:
    """Pairs of images of which one is among the nearest of the other, by their places."""
    nearest = nearest_points(places, places, most + 1)[1]
    pairs = np.sort(np.stack([np.repeat(images, nearest.shape[1]), images[nearest.ravel()]], axis=1), axis=1)
    return {(i, j) for i, j in pairs.tolist() if i != j}


def select_pairs(shared: Mapping[Pair, StoredMatches], cameras: Sequence[Camera]) -> dict[Pair, StoredMatches]:
    """Select those pairs that one of their images needs for its place, of pairs that share something.

    An image takes one partner after the other: the one whose matches add most to the sum of the square roots of the
    numbers of matches in its cells. So partners with many matches come first, but rather around the image than
    all on one side of it. Of a survey in which each image overlaps twenty others, a third of the pairs is left.
    """
    partners = defaultdict[int, list[tuple[Pair, FloatArray]]](list)
    for pair, matches in shared.items():
        matched = matches.load()
        for image, points in zip(pair, (matched.points1, matched.points2), strict=True):
            cell = np.clip(points / cameras[image].image_size * _CELLS_PER_SIDE, 0, _CELLS_PER_SIDE - 1).astype(np.intp)
            counts = np.bincount(cell @ [1, _CELLS_PER_SIDE], minlength=_CELLS_PER_SIDE**2)
            partners[image].append((pair, counts.astype(np.float64)))
    chosen: set[Pair] = set()
    for choices in partners.values():
        counts, covered = np.array([cells for _, cells in choices]), np.zeros(_CELLS_PER_SIDE**2)
        for _ in range(min(_PARTNERS, len(choices))):
            best = int(np.sqrt(covered + counts).sum(axis=1).argmax())
            chosen.add(choices[best][0])
            covered, counts[best] = covered + counts[best], 0.0
    return {pair: matches for pair, matches in shared.items() if pair in chosen}


def prescreen_pairs(estimator: PairEstimator, pairs: Sequence[Pair]) -> dict[Pair, StoredMatches]:
    """The pairs whose strongest features match and that matter for the place of an image, with those matches.

    A pair that is passed over may overlap nevertheless, by little: its place then follows from the others.
    """
    # These matches are few, of most pairs hardly any: a file for each would take as long as the matching.
    strongest = replace(estimator, features=estimator.features.strongest(_STRONGEST), store=estimator.cache)
    shared = dict(zip(pairs, strongest.match(pairs, "comparing images"), strict=True))
    most = np.zeros(len(estimator.features), dtype=np.intp)
    for pair, matches in shared.items():
        most[[*pair]] = np.maximum(most[[*pair]], len(matches))
    promising = {
        pair: matches
        for pair, matches in shared.items()
        if len(matches) >= max(_MIN_MATCHES, _MIN_RELATIVE_MATCHES * most[[*pair]].min())
    }
    return select_pairs(promising, estimator.cameras)


def estimate_candidates(estimator: PairEstimator, candidates: Sequence[Pair]) -> list[PairRegistration]:
    """Estimate the candidate pairs that share something at first sight; all of them where none of those holds."""
    prescreened = prescreen_pairs(estimator, candidates)
    pairs = estimator.estimate(prescreened, shared=prescreened)
    return pairs if any(pair.relation for pair in pairs) else estimator.estimate(candidates)


def loop_closures(
    cameras: Sequence[Camera],
    homographies: FloatArray,
    registered: set[Pair],
    failed: Set[Pair] = frozenset(),
    *,
    on_sphere: bool = False,
) -> list[Pair]:
    """Pairs that the poses put over one another and that were not tried yet, where the match graph needs them.

    It does not need a pair of images that both have their partners, one of them in common: that closes no loop. Only
    pairs that were ``registered`` make partners, not those that ``failed``.
    ``homographies`` (N, 3, 3) lead from undistorted normalized coordinates to the plane, or to directions
    (``on_sphere``); NaN for images without a pose.
    """
    middles = homographies[:, :, 2]
    with np.errstate(invalid="ignore"):
        ahead = np.isfinite(homographies).all(axis=(1, 2)) & (on_sphere | (middles[:, 2] > 0.0))
    known = np.flatnonzero(ahead)
    if len(known) < 2:
        return []
    size = np.linalg.norm(middles[known], axis=1) if on_sphere else middles[known, 2]
    centres = middles[known] / size[:, None]
    partners = defaultdict[int, set[int]](set)
    for i, j in registered:
        partners[i].add(j)
        partners[j].add(i)

    def needed(i: int, j: int) -> bool:
        return min(len(partners[i]), len(partners[j])) < _PARTNERS or not partners[i] & partners[j]

    untried = _nearest_pairs(centres, known, _NEIGHBOURS) - registered - failed
    pairs = [pair for pair in sorted(untried) if needed(*pair)]
    both = np.array([*pairs, *(pair[::-1] for pair in pairs)], dtype=np.intp).reshape(-1, 2)
    seen = _overlap_fractions(cameras, homographies, both)
    return [pair for pair, most in zip(pairs, seen.reshape(2, -1).max(axis=0), strict=True) if most >= _MIN_OVERLAP]


def _overlap_fractions(cameras: Sequence[Camera], homographies: FloatArray, pairs: IntArray) -> FloatArray:
    """Share of the first image of each pair (M, 2) that the second shows, by places on a grid over it, (M,)."""
    fraction = (np.arange(_PLACES_PER_SIDE) + 0.5) / _PLACES_PER_SIDE
    grid = np.stack(np.meshgrid(fraction, fraction), axis=-1).reshape(-1, 2)
    different = list(dict.fromkeys(cameras))  # most images are of one
    index = {camera: k for k, camera in enumerate(different)}
    of_image = np.array([index[camera] for camera in cameras])
    result = np.empty(len(pairs))
    for kinds in np.unique(of_image[pairs], axis=0):
        chosen = np.flatnonzero((of_image[pairs] == kinds).all(axis=1))
        first, second = (different[kind] for kind in kinds)
        flat = first.normalize(first.undistort(grid * first.image_size - 0.5))
        lifted = np.column_stack([flat, np.ones(len(flat))])
        for part in np.split(chosen, np.arange(_PAIRS_AT_ONCE, len(chosen), _PAIRS_AT_ONCE)):
            across = np.linalg.inv(homographies[pairs[part, 1]]) @ homographies[pairs[part, 0]]
            seen = second.distort(second.denormalize(project(lifted @ np.swapaxes(across, 1, 2))))
            with np.errstate(invalid="ignore"):
                inside = (seen > -0.5) & (seen < np.array(second.image_size) - 0.5)
            result[part] = inside.all(axis=2).mean(axis=1)
    return result
