"""Stage for images of a repeated pattern whose lens is wanted: matched by the crossings of its edges."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from rdstitch.alignment import Alignment
from rdstitch.arrays import FloatArray
from rdstitch.errors import RegistrationError
from rdstitch.features import Correspondences
from rdstitch.features.crossings import find_crossings
from rdstitch.features.prepared_image import Stretch, prepare
from rdstitch.geometry.nearest_points import nearest_points
from rdstitch.inputs.source import Source
from rdstitch.matching.feature_store import StoredMatches
from rdstitch.matching.pair_estimator import PairEstimator
from rdstitch.matching.repeated_pattern import shows_repeated_pattern
from rdstitch.matching.two_view import PairRegistration
from rdstitch.options.feature_options import CLOSER, WORK_MEGAPIXELS
from rdstitch.pipeline.aligner import AlignedPairs, Aligner
from rdstitch.robust.chance import occupied_cells

_MEGAPIXELS = WORK_MEGAPIXELS * CLOSER
_ROUNDS = 2  # of matching, the second one with the lens that the first one has found
_MIN_MATCHES = 12  # of a pair; of fewer its keypoints stay
_MIN_PLACES = 0.5  # of those in which a pair's keypoints lie, that its crossings must cover
_MIN_USED = 0.8  # of the images that were aligned by keypoints
_MAX_ERROR = 0.5  # of the error of keypoints that crossings must leave; saddles of other ground have as much


def match_crossings(
    aligner: Aligner,
    estimator: PairEstimator,
    aligned: AlignedPairs,
    sources: Sequence[Source],
    stretch: Stretch | None,
    workers: int,
) -> tuple[AlignedPairs, dict[int, str]]:
    """Align images of a repeated pattern again by the crossings of its edges, where it has any.

    The keypoints of a chessboard are the middles of its squares, which perspective and lens move by up to pixels, and
    places near their corners, which depend on the scale. Of rendered boards through a fisheye of 140 degrees, corners
    were 1.8 times as far off straight lines as with OpenCV's rational model from the corners; by crossings, 1.0 times.
    ``aligned``, by keypoints, is right to less than a period of the pattern. Given is the same as by
    :func:`rdstitch.pipeline.settle_repeated_pattern.settle_repeated_pattern`, whose place this takes.
    """
    if not shows_repeated_pattern(estimator):
        return aligned, {}
    former = aligned.alignment

    def crossings_of(k: int) -> FloatArray:
        points = find_crossings(prepare(sources[k].view(_MEGAPIXELS), _MEGAPIXELS, stretch=stretch))
        return (points + 0.5) * (np.array(former.cameras[k].image_size) / sources[k].camera.image_size) - 0.5

    crossings: dict[int, FloatArray] = {}
    by_crossings = aligned
    for _ in range(_ROUNDS):
        alignment = by_crossings.alignment
        # Images that keypoints did not place may be placed by the crossings of others.
        new = [k for k in np.flatnonzero(alignment.used).tolist() if k not in crossings]
        with ThreadPoolExecutor(workers) as pool:
            crossings.update(zip(new, pool.map(crossings_of, new), strict=True))
        pairs = [
            _matched(pair, alignment, crossings, aligner.threshold) if pair.images in alignment.support else pair
            for pair in aligned.pairs
        ]
        if all(new is old for new, old in zip(pairs, aligned.pairs, strict=True)):
            return aligned, {}
        try:
            by_crossings = aligner.align(pairs)
        except RegistrationError:
            return aligned, {}
    after = by_crossings.alignment
    better = after.rms < _MAX_ERROR * former.rms and after.used.sum() >= _MIN_USED * former.used.sum()
    return by_crossings if better else aligned, {}


def _matched(
    pair: PairRegistration, alignment: Alignment, crossings: Mapping[int, FloatArray], threshold: float
) -> PairRegistration:
    """A pair by the crossings that lie where the alignment expects them, and no others near; as it was if they are few.

    Crossings are (N, 2) in pixels, as the threshold.
    """
    first, second = crossings[pair.image1], crossings[pair.image2]
    expected = alignment.transfer(pair.image1, pair.image2, first)
    seen = np.flatnonzero(np.isfinite(expected).all(axis=1))
    if min(len(seen), len(second)) < _MIN_MATCHES:
        return pair
    distance, nearest = nearest_points(second, expected[seen], 2)
    back = nearest_points(expected[seen], second, 1)[1][:, 0]
    mutual = back[nearest[:, 0]] == np.arange(len(seen))
    chosen = (distance[:, 0] < threshold) & (distance[:, 1] > 2.0 * threshold) & mutual
    indices = np.column_stack([seen, nearest[:, 0]])[chosen]
    points1, points2 = first[indices[:, 0]], second[indices[:, 1]]
    keypoints, sizes = pair.link(), (pair.relation.camera.image_size, pair.relation.camera2.image_size)
    covered = occupied_cells(points1, points2, *sizes)
    before = occupied_cells(keypoints.points1, keypoints.points2, *sizes)
    if len(indices) < _MIN_MATCHES or covered < _MIN_PLACES * before:
        return pair
    matches = Correspondences(indices, points1, points2, np.zeros(len(indices)))
    relation = replace(pair.relation, inliers=np.ones(len(indices), dtype=np.bool_))
    return replace(pair, matches=StoredMatches.of(matches), relation=relation)
