"""Stages for images of a repeated pattern: placed by what is unique in them, or by the crossings of its edges."""

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
from rdstitch.geometry.radial_homography import RadialHomography, from_plane, to_plane
from rdstitch.inputs.source import Source
from rdstitch.matching.feature_store import StoredMatches
from rdstitch.matching.pair_estimator import PairEstimator
from rdstitch.matching.repeated_pattern import rematch_elsewhere, shows_repeated_pattern
from rdstitch.matching.two_view import PairRegistration
from rdstitch.numerics.nearest_points import nearest_points
from rdstitch.options.feature_options import CLOSER, WORK_MEGAPIXELS
from rdstitch.pipeline.registration.aligner import AlignedPairs, Aligner
from rdstitch.robust.chance import occupied_cells
from rdstitch.verification.overlap_check import ComparedImages
from rdstitch.verification.self_similarity import find_ambiguity
from rdstitch.verification.unique_places import IMAGES_AT_ONCE, unique_shifts

_PAIRS_OF_AN_IMAGE = 6  # pairs that are compared, by image on average: those taken one soon after the other first
_MIN_PLACED = 0.5  # of the images, that must find their place; of fewer nobody is helped
_UNDECIDED = "shows a repeated pattern, and nothing unique in it decides where it lies"
_MEGAPIXELS = WORK_MEGAPIXELS * CLOSER
_ROUNDS = 2  # of matching, the second one with the lens that the first one has found
_MIN_MATCHES = 12  # of a pair; of fewer its keypoints stay
_MIN_PLACES = 0.5  # of those in which a pair's keypoints lie, that its crossings must cover
_MIN_USED = 0.8  # of the images that were aligned by keypoints, that crossings must align
_MAX_ERROR = 0.5  # of the error of keypoints that crossings must leave; saddles of other ground have as much


def settle_repeated_pattern(
    aligner: Aligner,
    estimator: PairEstimator,
    aligned: AlignedPairs,
    sources: Sequence[Source],
    stretch: tuple[float, float] | None,
    workers: int,
) -> tuple[AlignedPairs, dict[int, str]]:
    """Move images of a repeated pattern by whole periods, to where dirt, marks and objects in them agree.

    Matches of such images agree as well some periods away, above all where the images share the most. Pairs that look
    as much alike elsewhere, and of which nothing unique decides where they lie, are taken for unregistered then, so
    that no place rests on them; those that look alike here alone stay as they are, marked parking beside a meadow for
    one. Where too few are left, or the plane is not metric, everything stays as it was: the checks judge that. Besides
    the pairs: why images have no place any more, by their index.
    """
    alignment = aligned.alignment
    if alignment.poses is None or len(sources) > IMAGES_AT_ONCE or not shows_repeated_pattern(estimator):
        return aligned, {}
    used = [pair for pair in aligned.pairs if pair.relation and alignment.used[[pair.image1, pair.image2]].all()]
    compared = sorted(used, key=lambda pair: pair.image2 - pair.image1)[: _PAIRS_OF_AN_IMAGE * len(sources)]
    views = ComparedImages(sources, stretch, workers).aligned(alignment, np.flatnonzero(alignment.used).tolist())
    with ThreadPoolExecutor(workers) as pool:
        ambiguities = pool.map(lambda pair: find_ambiguity(views[pair.image1], views[pair.image2]).ambiguous, compared)
        doubtful = [pair.images for pair, ambiguous in zip(compared, ambiguities, strict=True) if ambiguous]
    if not doubtful:
        return aligned, {}
    shifts = unique_shifts(views, doubtful, workers)

    def transfer(i: int, j: int, points: FloatArray) -> FloatArray:
        moved = to_plane(alignment.cameras[i], alignment.homographies[i], points) + shifts[i, j].shift
        return from_plane(alignment.cameras[j], alignment.homographies[j], moved)

    decided = [pair for pair in compared if pair.images in shifts]
    sound = [pair for pair in compared if pair.images not in doubtful]
    again = {pair.images: pair for pair in [*sound, *rematch_elsewhere(estimator, decided, transfer)]}
    try:
        settled = aligner.align([again.get(pair.images, _undecided(pair)) for pair in aligned.pairs])
    except RegistrationError:
        return aligned, {}
    placed = settled.alignment.used
    if placed.sum() < max(2, _MIN_PLACED * len(sources)):
        return aligned, {}
    return settled, dict.fromkeys(np.flatnonzero(alignment.used & ~placed).tolist(), _UNDECIDED)


def _undecided(pair: PairRegistration) -> PairRegistration:
    relation = pair.relation
    failed = RadialHomography.failed(_UNDECIDED, relation.camera, relation.camera2, len(pair.matches))
    return replace(pair, relation=failed)


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
    :func:`settle_repeated_pattern`, whose place this takes.
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
        holding = {fit.images for fit in alignment.holding}
        pairs = [
            _matched(pair, alignment, crossings, aligner.threshold) if pair.images in holding else pair
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
    """Match a pair by its crossings (N, 2), pixels, where the alignment expects them and no others are near.

    A pair with few such matches stays as it is.
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
