"""Stage for images of a repeated pattern: placed by what is unique in them."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.errors import RegistrationError
from rdstitch.geometry.radial_homography import RadialHomography, from_plane, to_plane
from rdstitch.inputs.source import Source
from rdstitch.matching.pair_estimator import PairEstimator
from rdstitch.matching.repeated_pattern import rematch_elsewhere, shows_repeated_pattern
from rdstitch.matching.two_view import PairRegistration
from rdstitch.pipeline.aligner import AlignedPairs, Aligner
from rdstitch.verification.overlap_check import ComparedImages
from rdstitch.verification.self_similarity import find_ambiguity
from rdstitch.verification.unique_places import IMAGES_AT_ONCE, unique_shifts

_PAIRS_OF_AN_IMAGE = 6  # pairs that are compared, by image on average: those taken one soon after the other first
_MIN_PLACED = 0.5  # of the images, that must find their place; of fewer nobody is helped
_UNDECIDED = "shows a repeated pattern, and nothing unique in it decides where it lies"


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
    shown = ComparedImages(sources, stretch, workers).aligned(alignment, np.flatnonzero(alignment.used).tolist())
    with ThreadPoolExecutor(workers) as pool:
        ambiguities = pool.map(lambda pair: find_ambiguity(shown[pair.image1], shown[pair.image2]).ambiguous, compared)
        doubtful = [pair.images for pair, ambiguous in zip(compared, ambiguities, strict=True) if ambiguous]
    if not doubtful:
        return aligned, {}
    shifts = unique_shifts(shown, doubtful, workers)

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
