"""Which of two motions in the same images is that of the plane?

A vehicle ahead, or a part of the robot, has matches that agree with each other, and may have more of them than the
plane. What contradicts a motion says which is which: something that hardly moves is put over nearly all of the next
image, and most of that looks different: it fills less than half of the images, for certain. The plane is put over a
part only, and may fill all that is not seen there.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rdstitch.executors import batches
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.radial_homography import RadialHomography
from rdstitch.matching.two_view import PAIRS_ESTIMATED_AT_ONCE, Pair, PairRegistration
from rdstitch.results.registration import Registration
from rdstitch.robust import EstimationOptions, PairMatches, estimate_radial_homographies
from rdstitch.system.late_imports import csgraph, sparse
from rdstitch.verification.limits import Limits
from rdstitch.verification.overlap_check import ComparedImages
from rdstitch.verification.photometric_agreement import Agreement, overlap_agreement


class _Candidate(NamedTuple):
    """A motion of a pair that may be that of the plane."""

    motion: RadialHomography
    plane_fraction: float  # of the images, that it fills at most


def planes_of_pairs(registration: Registration, threshold: float, threads: int = 1) -> list[PairRegistration] | None:
    """Replace the motion of each pair by that of its two strongest which may fill more than half of its images.

    Each pair decides for itself: where two motions are about as strong, some pairs were registered by one and some by
    the other, and no alignment holds both. None where no pair has a motion that fills less. ``threads``: pairs whose
    images are compared at the same time.
    """
    pairs = [pair for pair in registration.pairs if pair.relation]
    images = ComparedImages(registration.sources, registration.stretch, threads)

    def candidate(pair: Pair, motion: RadialHomography) -> _Candidate:
        first = images.placed(pair[0], motion.camera, motion.homography)
        agreement = overlap_agreement(first, images.placed(pair[1], motion.camera2, np.eye(3)))
        return _Candidate(motion, max_plane_fraction([agreement]))

    def candidates(motions: Mapping[Pair, RadialHomography]) -> dict[Pair, _Candidate]:
        with ThreadPoolExecutor(threads) as pool:
            return dict(zip(motions, pool.map(candidate, motions, motions.values()), strict=True))

    half = Limits.min_plane_fraction
    best = candidates({pair.images: pair.relation for pair in pairs})
    if all(each.plane_fraction >= half for each in best.values()):
        return None
    for pair, second in candidates(second_motions(registration.alignment.cameras, pairs, threshold)).items():
        best[pair] = max(best[pair], second, key=lambda each: each.plane_fraction)
    fractions = {pair: each.plane_fraction for pair, each in best.items()}
    needed = bottleneck_fraction({pair: fraction for pair, fraction in fractions.items() if fraction >= half})
    return [
        replace(pair, relation=best[pair.images].motion if fractions[pair.images] >= needed else _no_plane(pair))
        if pair.images in best
        else pair
        for pair in registration.pairs
    ]


def bottleneck_fraction(plane_fractions: Mapping[Pair, float]) -> float:
    """The largest fraction that pairs may be required to have and still join all images that all of them join."""
    if not plane_fractions:
        return math.inf
    first, second = np.array(list(plane_fractions)).T
    size = max(map(max, plane_fractions)) + 1
    graph = sparse.coo_array((-np.array(list(plane_fractions.values())), (first, second)), (size, size))
    return -float(csgraph.minimum_spanning_tree(graph.tocsr()).data.max())


def second_motions(
    cameras: Sequence[Camera], pairs: Sequence[PairRegistration], threshold: float
) -> Mapping[Pair, RadialHomography]:
    """Estimate of each pair the motion of most matches that its first motion does not explain.

    It has a λ of its own: that of a vehicle, whose image hardly changes, says nothing.
    """
    result = {}
    rests = {pair.images: np.flatnonzero(~pair.relation.inliers) for pair in pairs}
    enough = [pair for pair in pairs if len(rests[pair.images]) >= Limits.min_motion_inliers]
    for batch in batches(enough, PAIRS_ESTIMATED_AT_ONCE):
        given = []
        for pair in batch:
            matches = pair.correspondences.take(rests[pair.images])
            first, second = (cameras[k].without_focal() for k in pair.images)
            given.append(PairMatches(matches.points1, matches.points2, first, second, -matches.ratio))
        motions = estimate_radial_homographies(given, EstimationOptions(threshold=threshold))
        for pair, motion in zip(batch, motions, strict=True):
            if motion and int(motion.inliers.sum()) >= Limits.min_motion_inliers:
                inliers = np.zeros(len(pair.matches), dtype=np.bool_)
                inliers[rests[pair.images][motion.inliers]] = True
                result[pair.images] = replace(motion, inliers=inliers)
    return result


def max_plane_fraction(compared: Iterable[Agreement]) -> float:
    """Fraction of the images of some pairs that is not seen to contradict a motion, in [0, 1]."""
    agreements = list(compared)
    return 1.0 - sum(each.unlike_cells for each in agreements) / max(sum(each.textured_cells for each in agreements), 1)


def _no_plane(pair: PairRegistration) -> RadialHomography:
    relation, reason = pair.relation, "what the two share fills less than half of them (something that moved?)"
    return RadialHomography.failed(reason, relation.camera, relation.camera2, len(relation.inliers))
