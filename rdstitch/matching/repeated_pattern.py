"""Matches between images of a pattern that repeats itself: a chessboard, tiles, a board of tags.

There each keypoint looks like many, so that no match is distinctive. But each of its likely partners says how the whole
image would be turned, scaled and moved, by the places, scales and orientations of the two keypoints alone; the motion
that most keypoints have a partner for is right, or off by whole periods of the pattern. That is as good for the lens:
a board that is shifted by a square is as flat as before. It is not for the places of the images.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rdstitch.arrays import BoolArray, FloatArray, IntArray, evenly_spaced
from rdstitch.features import Correspondences, Features, match_near
from rdstitch.matching.feature_store import StoredMatches
from rdstitch.matching.pair_estimator import FeatureMatching, PairEstimator
from rdstitch.matching.two_view import PairRegistration, Transfer

_MIN_REPETITION = 0.1
"""Of :func:`repetition`: images with more may show a repeated pattern. Boards have 0.15 to 0.8, flights up to
0.01, but up to 0.6 over a car park or mown grass."""

_SIMILAR_DISTANCE = 0.45  # of the median distance between descriptors of an image: nearer ones look the same
_MIN_REPETITIONS = 4  # keypoints elsewhere that look the same, of one that repeats itself
_MAX_KEYPOINTS = 1000  # keypoints that are looked at for that
_PARTNERS = 6  # likely partners of each keypoint
_DISTANCES = 2_000_000  # between descriptors, that are computed at a time
_HYPOTHESES = 400  # motions that are tried, each by one keypoint and one partner
_REFINED = 4  # of them, the best, that are refined
_MAX_SCALE = 2.5  # of one image in the other
_TURN = 0.5  # radians by which one keypoint's motion may differ from another's
_LOG_SCALE = 0.5  # logarithm of the scale by which it may
_NEAR = 0.01  # half diagonals: error of such a motion beside its keypoint
_SPREAD = 0.12  # growth of that error with the distance from it
_FAR = 0.06  # half diagonals: that error at the most
_TOLERANCES = (0.05, 0.035, 0.025, 0.02, 0.015, 0.015)  # half diagonals, of the rounds of refinement
_AFFINE_ROUNDS = 2  # the first ones; then the quadratic one, which perspective and lens ask for
_MIN_MATCHES = 20
_SAMPLED = 5  # images that are looked at for a repeated pattern
_FEW_INLIERS = 50  # of a pair of a repeated pattern, which shows hundreds of keypoints
_MIN_INLIER_RATIO = 0.7  # of such matches that agree: right pairs have 0.8 to 1, lattices that hardly match half
_SEARCH_RADIUS = 3.0  # thresholds around the place where a match is expected


def shows_repeated_pattern(estimator: PairEstimator) -> bool:
    """Whether keypoints of most of the images look like others elsewhere in the same image."""
    if estimator.matching.network is not None:
        return False
    sampled = evenly_spaced(len(estimator.features), _SAMPLED).tolist()
    return bool(np.median([repetition(estimator.features[k]) for k in sampled]) >= _MIN_REPETITION)


def match_repeated_patterns(estimator: PairEstimator, pairs: list[PairRegistration]) -> list[PairRegistration]:
    """Where the images show a repeated pattern, match again the pairs that failed or hold by little.

    They may be off by whole periods of the pattern then.
    """
    if not shows_repeated_pattern(estimator):
        return pairs
    weak = [k for k, pair in enumerate(pairs) if not pair.relation or pair.relation.inliers.sum() < _FEW_INLIERS]
    chosen, distortion = [pairs[k].images for k in weak], estimator.estimation.distortion
    by_pattern = replace(estimator, matching=FeatureMatching(match_pattern, name="repeated pattern"))
    matched = by_pattern.match(chosen, "matching a repeated pattern")
    rematched = estimator.estimate_matched(chosen, matched, distortion, "registering pairs")
    result = list(pairs)
    for k, pair in zip(weak, rematched, strict=True):
        inliers = pair.relation.inliers.sum()
        if pair.relation and inliers > max(_MIN_INLIER_RATIO * len(pair.matches), pairs[k].relation.inliers.sum()):
            result[k] = pair
    return result


def rematch_elsewhere(
    estimator: PairEstimator, pairs: Sequence[PairRegistration], transfer: Transfer
) -> list[PairRegistration]:
    """Match registered pairs again, only near where ``transfer`` puts them."""
    matched, options = [], estimator.estimation
    for pair in pairs:
        features1, features2 = estimator.features[pair.image1], estimator.features[pair.image2]
        expected = transfer(pair.image1, pair.image2, features1.points)
        known = pair.correspondences.indices[pair.relation.inliers]
        near = match_near(
            features1, features2, expected, _SEARCH_RADIUS * options.threshold, known, estimator.matching.ratio
        )
        matched.append(StoredMatches.of(near))
    return estimator.estimate_matched([pair.images for pair in pairs], matched, options.distortion)


def repetition(features: Features) -> float:
    """Share of the keypoints that look like at least four others elsewhere in the image, in [0, 1]."""
    strongest = features.take(np.arange(min(len(features), _MAX_KEYPOINTS)))
    if features.binary or len(strongest) <= _MIN_REPETITIONS:
        return 0.0
    squared = _squared_distances(strongest, strongest)
    # The median of a sixteenth of the rows is that of all.
    one, other = np.nonzero(squared < _SIMILAR_DISTANCE**2 * np.median(squared[::16]))
    distance = np.linalg.norm(strongest.points[one] - strongest.points[other], axis=1)
    elsewhere = distance > 2.0 * np.maximum(strongest.scale[one], strongest.scale[other])
    alike = np.bincount(one[elsewhere], minlength=len(strongest))
    return float(np.mean(alike >= _MIN_REPETITIONS))


def match_pattern(features1: Features, features2: Features) -> Correspondences:
    """Matches by the motion of the whole image that most keypoints have a likely partner for.

    ``features1, features2``: with orientations and descriptors of numbers; of others nothing is matched; gives in the
    order of their distance from where that motion puts them; none where it finds few.
    """
    nothing = Correspondences.of(features1, features2, np.empty((0, 2), dtype=np.intp), np.empty(0))
    if features1.binary or features2.binary or min(len(features1), len(features2)) <= _PARTNERS:
        return nothing
    half = float(np.hypot(*(features1.image_size or np.ptp(features1.points, axis=0)))) / 2.0
    keypoint, partner, distance = _partners(features1, features2)
    z1, z2 = (f.points[of] @ np.array([1.0, 1.0j]) / half for f, of in ((features1, keypoint), (features2, partner)))
    turn = features2.angle[partner] - features1.angle[keypoint]
    motion = features2.scale[partner] / features1.scale[keypoint] * np.exp(1j * turn)
    likely = np.argsort(distance, kind="stable")[: len(distance) // 2]
    tried = likely[evenly_spaced(len(likely), _HYPOTHESES)]
    support = np.array([len(np.unique(keypoint[_agreeing(z1, z2, motion, index)])) for index in tried])
    best, error = np.zeros(len(keypoint), dtype=np.bool_), np.full(len(keypoint), np.inf)
    for index in tried[np.argsort(-support, kind="stable")[:_REFINED]]:
        agreeing, errors = _refined(z1, z2, _agreeing(z1, z2, motion, int(index)))
        if len(np.unique(keypoint[agreeing])) > len(np.unique(keypoint[best])):
            best, error = agreeing, errors
    chosen = np.flatnonzero(best)[np.argsort(error[best], kind="stable")]
    for index in (keypoint, partner):  # each keypoint once, with the partner that fits best
        chosen = chosen[np.sort(np.unique(index[chosen], return_index=True)[1])]
    if len(chosen) < _MIN_MATCHES:
        return nothing
    indices = np.column_stack([keypoint[chosen], partner[chosen]])
    return Correspondences.of(features1, features2, indices, error[chosen] / _TOLERANCES[-1])


def _squared_distances(features1: Features, features2: Features) -> NDArray[np.float32]:
    """Between all descriptors, (N, M)."""
    a, b = (f.descriptors.astype(np.float32) for f in (features1, features2))
    squared: NDArray[np.float32] = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1) - 2.0 * a @ b.T
    return np.maximum(squared, 0.0, out=squared)


def _partners(features1: Features, features2: Features) -> tuple[IntArray, IntArray, FloatArray]:
    """Keypoints of the first image, each with its likely partners in the second, and how unlike they are."""
    shape, rows = (len(features1), _PARTNERS), max(1, _DISTANCES // len(features2))
    nearest, distances = np.empty(shape, np.intp), np.empty(shape)
    for start in range(0, len(features1), rows):
        part = np.arange(start, min(start + rows, len(features1)))
        squared = _squared_distances(features1.take(part), features2)
        nearest[part] = np.argpartition(squared, _PARTNERS, axis=1)[:, :_PARTNERS]
        distances[part] = np.sqrt(np.take_along_axis(squared, nearest[part], axis=1))
    keypoint, partner, distance = np.repeat(np.arange(len(features1)), _PARTNERS), nearest.ravel(), distances.ravel()
    scale = np.abs(np.log(features2.scale[partner] / features1.scale[keypoint]))
    kept = scale < np.log(_MAX_SCALE)
    return keypoint[kept], partner[kept], distance[kept]


def _agreeing(
    z1: NDArray[np.complex128], z2: NDArray[np.complex128], motion: NDArray[np.complex128], index: int
) -> BoolArray:
    """Which matches (M,) agree with the similarity that one of them says."""
    expected = z2[index] + motion[index] * (z1 - z1[index])
    tolerance = np.minimum(_NEAR + _SPREAD * np.abs(expected - z2[index]), _FAR)
    relative = np.log(motion / motion[index])
    near = np.abs(expected - z2) < tolerance
    return np.asarray(near & (np.abs(relative.real) < _LOG_SCALE) & (np.abs(relative.imag) < _TURN))


def _refined(
    z1: NDArray[np.complex128], z2: NDArray[np.complex128], agreeing: BoolArray
) -> tuple[BoolArray, FloatArray]:
    """The matches that agree with a smooth map that is fitted to them, in rounds of falling tolerance; its errors."""
    x, y = z1.real, z1.imag
    terms = np.column_stack([np.ones(len(z1)), x, y, x * x, x * y, y * y])
    errors = np.full(len(z1), np.inf)
    for number, tolerance in enumerate(_TOLERANCES):
        used = terms[:, :3] if number < _AFFINE_ROUNDS else terms
        if agreeing.sum() < max(2 * used.shape[1], _MIN_MATCHES // 2):
            return np.zeros_like(agreeing), errors
        fitted = np.linalg.lstsq(used[agreeing], z2[agreeing], rcond=None)[0]
        errors = np.abs(used @ fitted - z2)
        agreeing = errors < tolerance
    return agreeing, errors
