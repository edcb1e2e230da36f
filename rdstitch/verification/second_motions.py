"""Of two motions in the same images, which is that of the plane?

A vehicle ahead, or a part of the robot, has matches that agree with each other, and may have more of them than the
plane. What contradicts a motion says which is which: something that hardly moves is put over nearly all of the next
image, and most of that looks different: it fills less than half of the images, for certain. The plane is put over a
part only, and may fill all that is not seen there.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

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


def planes_of_pairs(registration: Registration, threshold: float, threads: int = 1) -> list[PairRegistration] | None:
    """Every pair by that of its two strongest motions which may fill more than half of its images.

    Each pair decides for itself: where two motions are about as strong, some pairs were registered by one and some by
    the other, and no alignment holds both. None where no pair has a motion that fills less. ``threads``: pairs whose
    images are compared at the same time.
    """
    pairs = [pair for pair in registration.pairs if pair.relation]
    images = ComparedImages(registration.sources, registration.stretch, threads)

    def fills(pair: Pair, motion: RadialHomography) -> tuple[float, RadialHomography]:
        first = images.placed(pair[0], motion.camera, motion.homography)
        return max_plane_fraction([overlap_agreement(first, images.placed(pair[1], motion.camera2, np.eye(3)))]), motion

    def filled_by(motions: Mapping[Pair, RadialHomography]) -> dict[Pair, tuple[float, RadialHomography]]:
        with ThreadPoolExecutor(threads) as pool:
            return dict(zip(motions, pool.map(fills, motions, motions.values()), strict=True))

    half = Limits.min_plane_fraction
    planes = filled_by({pair.images: pair.relation for pair in pairs})
    if all(fraction >= half for fraction, _ in planes.values()):
        return None
    for pair, filled in filled_by(second_motions(registration.alignment.cameras, pairs, threshold)).items():
        planes[pair] = max(planes[pair], filled, key=lambda each: each[0])
    needed = bottleneck_fraction({pair: fraction for pair, (fraction, _) in planes.items() if fraction >= half})
    return [
        replace(pair, relation=planes[pair.images][1] if planes[pair.images][0] >= needed else _no_plane(pair))
        if pair.images in planes
        else pair
        for pair in registration.pairs
    ]


def bottleneck_fraction(fills: Mapping[Pair, float]) -> float:
    """The share from which on pairs join all images that all of them join: those of less may show anything."""
    if not fills:
        return math.inf
    first, second = np.array(list(fills)).T
    graph = sparse.coo_array((-np.array(list(fills.values())), (first, second)), (max(map(max, fills)) + 1,) * 2)
    return -float(csgraph.minimum_spanning_tree(graph.tocsr()).data.max())


def second_motions(
    cameras: Sequence[Camera], pairs: Sequence[PairRegistration], threshold: float
) -> Mapping[Pair, RadialHomography]:
    """Of each pair the motion that most of the matches agree on that its own does not explain, with its own λ: that of
    a vehicle, whose image hardly changes, says nothing.
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
    """Share of the images of some pairs that is not seen to contradict a motion, in [0, 1]."""
    agreements = list(compared)
    return 1.0 - sum(each.unlike_cells for each in agreements) / max(sum(each.textured_cells for each in agreements), 1)


def _no_plane(pair: PairRegistration) -> RadialHomography:
    relation, reason = pair.relation, "what the two share fills less than half of them (something that moved?)"
    return RadialHomography.failed(reason, relation.camera, relation.camera2, len(relation.inliers))
